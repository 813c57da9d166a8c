//! Several `NumPy` arrays in one file (`.npz`, a zip archive): the frames, and perhaps actions, states and timestamps, by
//! their names.

use std::fs::File;
use std::io::{Read, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use zip::read::ZipFile;
use zip::result::ZipError;
use zip::{CompressionMethod, ZipArchive};

use super::files::{open_file, stem};
use super::numpy::{ArrayHeader, FrameLayout, FramePosition};
use super::recording::{Record, Recording, seconds_per_unit};
use super::skipped::listed;
use super::{ImportConfig, ImportError, ImportOptions};
use foreframe_core::files::partial_path;
use foreframe_core::types::Channel;

/// Names of the arrays if none are given.
const FRAMES: [&str; 6] = ["frames", "images", "image", "observations", "obs", "video"];
const ACTIONS: [&str; 2] = ["actions", "action"];
const STATES: [&str; 2] = ["states", "state"];
/// Names of times, and their unit in seconds.
const TIMES: [(&str, f64); 8] = [
    ("timestamps", 1.0),
    ("timestamp", 1.0),
    ("times", 1.0),
    ("time", 1.0),
    ("timestamps_s", 1.0),
    ("timestamps_ms", 1e-3),
    ("timestamps_us", 1e-6),
    ("timestamps_ns", 1e-9),
];
/// One byte of a deflated array becomes at most this many.
const MAX_COMPRESSION: u64 = 1033;
/// Actions, states and times are in memory as a whole.
const MAX_VALUES_BYTES: u64 = 1 << 30;

/// Bytes that are decompressed between two looks at the cancel flag.
const PIECE_BYTES: u64 = 1 << 20;

/// Reads all arrays but the frames. Compressed frames are decompressed beside the data set. Errors: `Option`, `Io`, `Record`,
/// `Disk`, `Stopped`.
pub(super) fn open(config: &ImportConfig, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let (path, options) = (config.source.as_path(), &config.options);
    let mut npz = Npz::open(path)?;
    let frames = npz.frames(options)?;
    let header = npz.header(&frames)?;
    let layout = FrameLayout::of(&header, &npz.place(&frames))?;
    npz.check_size(&frames, &header)?;
    let mut read = |given: &[String], usual: &[&str], what: &'static str| {
        let names = npz.chosen(given, usual, what)?;
        let rows = names.iter().map(|name| npz.rows(name, &layout));
        Ok::<_, ImportError>((rows.collect::<Result<Vec<_>, _>>()?, names))
    };
    let (actions, action_names) = read(&options.actions, &ACTIONS, "--action")?;
    let (states, state_names) = read(&options.states, &STATES, "--state")?;
    let times = npz.times(options, &layout)?;
    let place = npz.place(&frames);
    let mut records = Vec::new();
    for at in layout.positions() {
        let of = |arrays: &[ArrayRows]| arrays.iter().flat_map(|rows| rows.at(at.index)).collect();
        records.push(Record {
            action: of(&actions),
            state: of(&states),
            ..at.record(records.len(), times.at(&at), &place)
        });
    }
    let (pixels, file, start) = npz.pixels(&frames, &header, config, cancelled)?;
    let images = layout.images(&pixels, file, start);
    Ok(Recording {
        action_channels: channels(&action_names, &actions, options),
        state_channels: channels(&state_names, &states, options),
        ..Recording::of_images(stem(path, "array"), records, images)
    })
}

/// An array of one row of numbers per frame.
struct ArrayRows {
    values: Vec<f64>,
    width: usize,
}

impl ArrayRows {
    fn at(&self, frame: usize) -> Vec<f32> {
        let row = &self.values[frame * self.width..(frame + 1) * self.width];
        row.iter().map(|&value| value as f32).collect()
    }
}

/// When each frame was taken.
enum FrameTimes {
    /// An array, and its unit in seconds.
    Array(ArrayRows, f64),
    /// Frames per second.
    Rate(f64),
}

impl FrameTimes {
    fn at(&self, at: &FramePosition) -> f64 {
        match self {
            Self::Array(rows, unit_s) => rows.values[at.index] * unit_s,
            Self::Rate(rate) => at.frame as f64 / rate,
        }
    }
}

fn channels(names: &[String], arrays: &[ArrayRows], options: &ImportOptions) -> Vec<Channel> {
    let mut channels = Vec::new();
    for (name, rows) in names.iter().zip(arrays) {
        for component in 0..rows.width {
            let name = match rows.width {
                1 => name.clone(),
                _ => format!("{name}.{component}"),
            };
            channels.push(Channel::new(&name, &options.unit(&name)));
        }
    }
    channels
}

/// An open archive.
struct Npz {
    path: PathBuf,
    archive: ZipArchive<File>,
    /// Names of the arrays, without `.npy`.
    names: Vec<String>,
}

impl Npz {
    fn open(path: &Path) -> Result<Self, ImportError> {
        let file = open_file(path)?;
        let wrong = |error: ZipError| {
            let reason = format!("this is not a .npz file of numpy.savez, or it was cut off: {error}");
            ImportError::record(path.display().to_string(), reason)
        };
        let archive = ZipArchive::new(file).map_err(wrong)?;
        let names = archive.file_names().filter_map(Result::ok);
        let names = names
            .filter_map(|name| name.strip_suffix(".npy").map(str::to_owned))
            .collect();
        Ok(Self {
            path: path.to_owned(),
            archive,
            names,
        })
    }

    fn place(&self, name: &str) -> String {
        format!("{} array {name}", self.path.display())
    }

    fn missing(&self, what: &str, option: &str) -> ImportError {
        ImportError::Option(format!(
            "{} has no {what} ({option}); its arrays are: {}",
            self.path.display(),
            listed(&self.names)
        ))
    }

    fn has(&self, name: &str) -> bool {
        self.names.iter().any(|known| known == name)
    }

    /// The array of the frames: the one named, one of the usual names, or the only one.
    fn frames(&self, options: &ImportOptions) -> Result<String, ImportError> {
        if let Some(name) = &options.image {
            let known = self.has(name).then(|| name.clone());
            return known.ok_or_else(|| self.missing(&format!("array \"{name}\""), "--image"));
        }
        if let Some(name) = FRAMES.iter().find(|name| self.has(name)) {
            return Ok((*name).to_owned());
        }
        match self.names.as_slice() {
            [only] => Ok(only.clone()),
            _ => Err(self.missing(&format!("array named {}", FRAMES.join(", ")), "--image")),
        }
    }

    /// The arrays named, or the one of the usual names.
    fn chosen(&self, given: &[String], usual: &[&str], option: &str) -> Result<Vec<String>, ImportError> {
        if let Some(name) = given.iter().find(|name| !self.has(name)) {
            return Err(self.missing(&format!("array \"{name}\""), option));
        }
        let found = usual.iter().find(|name| self.has(name));
        let found = found.map(|name| (*name).to_owned()).into_iter().collect();
        Ok(if given.is_empty() { found } else { given.to_vec() })
    }

    /// An array's file in the archive. Errors: `Record`.
    fn entry(&mut self, name: &str) -> Result<ZipFile<'_, File>, ImportError> {
        let place = self.place(name);
        let entry = self.archive.by_name(&format!("{name}.npy"));
        entry.map_err(|error| ImportError::record(place, error.to_string()))
    }

    /// Reads an array's beginning. Errors: `Record`, `Io`.
    fn header(&mut self, name: &str) -> Result<ArrayHeader, ImportError> {
        let place = self.place(name);
        ArrayHeader::read(self.entry(name)?, &place)
    }

    /// Checks that the archive can hold an array of this shape. Errors: `Record`.
    fn check_size(&mut self, name: &str, header: &ArrayHeader) -> Result<(), ImportError> {
        let place = self.place(name);
        let entry = self.entry(name)?;
        let needed = header.data_offset.saturating_add(header.bytes());
        // What the archive states can be wrong as well.
        let found = entry
            .size()
            .min(entry.compressed_size().saturating_mul(MAX_COMPRESSION));
        if found < needed {
            let reason = format!(
                "it has {found} bytes at most; its shape {:?} needs {needed}",
                header.shape
            );
            return Err(ImportError::record(place, reason));
        }
        Ok(())
    }

    /// Reads an array with as many rows as there are frames. Errors: `Record`.
    fn rows(&mut self, name: &str, layout: &FrameLayout) -> Result<ArrayRows, ImportError> {
        let place = self.place(name);
        let wrong = |reason: String| ImportError::record(&place, reason);
        let mut entry = self.entry(name)?;
        let header = ArrayHeader::read(&mut entry, &place)?;
        let Some(rest) = header.shape.strip_prefix(layout.leading.as_slice()) else {
            return Err(wrong(format!(
                "its shape is {:?}; it must begin with {:?}, as that of the frames",
                header.shape, layout.leading
            )));
        };
        let width = rest.iter().try_fold(1usize, |width, &side| width.checked_mul(side));
        let count = width.and_then(|width| width.checked_mul(layout.sequences * layout.frames));
        let bytes = count.and_then(|count| (count as u64).checked_mul(header.number.bytes() as u64));
        let (Some(width), Some(bytes)) = (width, bytes.filter(|bytes| *bytes <= MAX_VALUES_BYTES)) else {
            return Err(wrong(format!("its shape {:?} is too large", header.shape)));
        };
        let mut content = Vec::new();
        entry
            .take(bytes)
            .read_to_end(&mut content)
            .map_err(|error| wrong(format!("it cannot be decompressed: {error}")))?;
        if content.len() as u64 != bytes {
            return Err(wrong(format!(
                "it has {} bytes; its shape needs {bytes}",
                content.len()
            )));
        }
        let values = header.number.values(&content);
        match values.iter().position(|value| !(*value as f32).is_finite()) {
            Some(at) => Err(wrong(format!(
                "value {at} is {}; it must be a finite number",
                values[at]
            ))),
            None => Ok(ArrayRows { values, width }),
        }
    }

    fn times(&mut self, options: &ImportOptions, layout: &FrameLayout) -> Result<FrameTimes, ImportError> {
        let usual = TIMES.iter().find(|(name, _)| self.has(name));
        let (name, unit_s) = match (&options.time, usual) {
            (Some(name), _) if !self.has(name) => {
                return Err(self.missing(&format!("array \"{name}\""), "--time"));
            }
            (Some(name), _) => (name.clone(), seconds_per_unit(name)),
            (None, Some((name, unit_s))) => ((*name).to_owned(), *unit_s),
            (None, None) => {
                let rate = options.rate_hz.map(FrameTimes::Rate);
                return rate.ok_or_else(|| self.missing("array of timestamps, nor a rate", "--time, --rate"));
            }
        };
        let rows = self.rows(&name, layout)?;
        match rows.width {
            1 => Ok(FrameTimes::Array(rows, unit_s)),
            width => Err(ImportError::record(
                self.place(&name),
                format!("it has {width} numbers per frame; timestamps have one"),
            )),
        }
    }

    /// The file with the frames' values, its name, and where they begin in it. Errors: `Record`, `Io`, `Disk`, `Stopped`.
    fn pixels(
        &mut self,
        name: &str,
        header: &ArrayHeader,
        config: &ImportConfig,
        cancelled: &AtomicBool,
    ) -> Result<(PathBuf, File, u64), ImportError> {
        let (path, place) = (self.path.clone(), self.place(name));
        let entry = self.entry(name)?;
        let needed = header.data_offset.saturating_add(header.bytes());
        if entry.compression() == CompressionMethod::Stored
            && let Some(start) = entry.data_start()
        {
            let file = File::open(&path).map_err(ImportError::io("read", &path))?;
            return Ok((path, file, start + header.data_offset));
        }
        let needed_mib = needed.div_ceil(1 << 20);
        if needed_mib > config.disk_mib {
            return Err(ImportError::Disk {
                needed_mib,
                limit_mib: config.disk_mib,
            });
        }
        let (decoded, mut file) = temporary_file(&config.out)?;
        let mut rest = entry.take(needed);
        let mut piece = Vec::new();
        loop {
            if cancelled.load(Ordering::Relaxed) {
                return Err(ImportError::Stopped);
            }
            piece.clear();
            let read = rest.by_ref().take(PIECE_BYTES).read_to_end(&mut piece);
            let read = read.map_err(|error| ImportError::record(&place, format!("it cannot be decompressed: {error}")));
            if read? == 0 {
                return Ok((decoded, file, header.data_offset));
            }
            file.write_all(&piece).map_err(ImportError::io("write", &decoded))?;
        }
    }
}

/// A new file in a directory, which only this process uses and the system removes with it. Where an open file cannot be removed, it
/// stays as a partial file, which the end of the import or its next run removes. Errors: `Io`.
fn temporary_file(directory: &Path) -> Result<(PathBuf, File), ImportError> {
    let failed = ImportError::io("write", directory);
    let path = partial_path(&directory.join("frames"));
    let created = path.and_then(|path| {
        let file = File::options().read(true).write(true).create_new(true).open(&path)?;
        let _ = std::fs::remove_file(&path);
        Ok((path, file))
    });
    created.map_err(failed)
}
