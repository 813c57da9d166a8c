//! Several `NumPy` arrays in one file (`.npz`, a zip archive): the frames, and perhaps actions, states and timestamps, by
//! their names.

use std::fs::File;
use std::io::{Read, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use zip::read::ZipFile;
use zip::{CompressionMethod, ZipArchive};

use super::files::{open_file, stem};
use super::numpy::{ArrayHeader, holds_texts};
use super::options::are_none;
use super::raw_images::{FrameLayout, FramePosition, RawImages};
use super::recording::{Record, Recording, seconds_per_unit};
use super::skipped::listed;
use super::{ImportConfig, ImportError, ImportOptions};
use foreframe_core::files::{PositionedFile, partial_path};
use foreframe_core::types::Channel;

/// Names of the arrays if none are given.
const FRAMES: [&str; 6] = ["frames", "images", "image", "observations", "obs", "video"];
const ACTIONS: [&str; 2] = ["actions", "action"];
const STATES: [&str; 2] = ["states", "state"];
const TIMES: [&str; 8] = [
    "timestamps",
    "timestamp",
    "times",
    "time",
    "timestamps_s",
    "timestamps_ms",
    "timestamps_us",
    "timestamps_ns",
];
/// One byte of a deflated array becomes at most this many.
const MAX_COMPRESSION: u64 = 1033;
/// Actions, states and times are in memory as a whole.
const MAX_VALUES_BYTES: u64 = 1 << 30;

/// Bytes that are decompressed between two looks at the cancel flag.
const PIECE_BYTES: u64 = 1 << 20;

/// Reads all arrays but the frames. Compressed frames are decompressed beside the data set. Errors: `Option`, `Io`, `Record`,
/// `Disk`, `Stopped`.
pub(super) fn open(path: &Path, config: &ImportConfig, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let options = &config.options;
    let mut npz = Npz::open(path)?;
    let frames = npz.frames(options)?;
    let place = npz.place(&frames);
    let header = ArrayHeader::read(npz.entry(&frames)?, &place)?;
    let layout = FrameLayout::of(header.number, &header.shape, &place)?;
    npz.check_size(&frames, &header)?;
    let actions = npz.chosen(&options.actions, &ACTIONS, "--action", &layout)?;
    let states = npz.chosen(&options.states, &STATES, "--state", &layout)?;
    let times = npz.times(options, &layout)?;
    // Without times, there is a rate.
    let period_s = options.rate_hz.map_or(1.0, f64::recip);
    let record = |at: FramePosition| {
        let of = |arrays: &[ArrayRows]| arrays.iter().flat_map(|rows| rows.at(at.index)).collect();
        let time_s = times.as_ref().map_or(at.frame as f64 * period_s, |(rows, unit_s)| {
            rows.values[at.index] * unit_s
        });
        Record {
            action: of(&actions),
            state: of(&states),
            ..at.record(time_s, &place)
        }
    };
    let records = layout.positions().map(record).collect();
    let (path_of_frames, file, start) = npz.pixels(&frames, &header, config, cancelled)?;
    let images = RawImages {
        path: path_of_frames,
        file: PositionedFile::new(file),
        start,
        layout,
    };
    let channels = |arrays: &[ArrayRows]| arrays.iter().flat_map(|rows| rows.channels(options)).collect();
    Ok(Recording {
        action_channels: channels(&actions),
        state_channels: channels(&states),
        notes: npz.notes,
        ..Recording::new(stem(path, "array"), records, images)
    })
}

/// An array of one row of numbers per frame.
struct ArrayRows {
    name: String,
    values: Vec<f64>,
    width: usize,
}

impl ArrayRows {
    fn at(&self, frame: usize) -> impl Iterator<Item = f32> {
        let row = &self.values[frame * self.width..(frame + 1) * self.width];
        row.iter().map(|&value| value as f32)
    }

    fn channels(&self, options: &ImportOptions) -> Vec<Channel> {
        match self.width {
            1 => vec![options.channel(&self.name, "")],
            width => (0..width)
                .map(|component| options.channel(&format!("{}.{component}", self.name), ""))
                .collect(),
        }
    }
}

/// An open archive.
struct Npz {
    path: PathBuf,
    archive: ZipArchive<File>,
    /// Names of the arrays, without `.npy`.
    names: Vec<String>,
    /// What was left out of the actions and states, in sentences for the user.
    notes: Vec<String>,
}

impl Npz {
    fn open(path: &Path) -> Result<Self, ImportError> {
        let archive = ZipArchive::new(open_file(path)?).map_err(|error| {
            let reason = format!("this is not a .npz file of numpy.savez, or it was cut off: {error}");
            ImportError::record(path.display(), reason)
        })?;
        let names = archive.file_names().filter_map(Result::ok);
        let names = names.filter_map(|name| name.strip_suffix(".npy").map(str::to_owned));
        Ok(Self {
            path: path.to_owned(),
            names: names.collect(),
            notes: Vec::new(),
            archive,
        })
    }

    fn place(&self, name: &str) -> String {
        format!("{} array {name}", self.path.display())
    }

    fn missing(&self, what: &str, option: &str) -> ImportError {
        let (path, names) = (self.path.display(), listed(&self.names));
        ImportError::Option(format!("{path} has no {what} ({option}); its arrays are: {names}"))
    }

    fn has(&self, name: &str) -> bool {
        self.names.iter().any(|known| known == name)
    }

    /// The array that was named, else the first of the usual names. Errors: `Option` if there is none of the name given.
    fn find(&self, given: Option<&String>, usual: &[&str], option: &str) -> Result<Option<String>, ImportError> {
        match given {
            Some(name) if self.has(name) => Ok(Some(name.clone())),
            Some(name) => Err(self.missing(&format!("array \"{name}\""), option)),
            None => Ok(usual.iter().find(|name| self.has(name)).map(|name| (*name).to_owned())),
        }
    }

    /// The array of the frames: the one named, one of the usual names, or the only one.
    fn frames(&self, options: &ImportOptions) -> Result<String, ImportError> {
        let found = self.find(options.image.as_ref(), &FRAMES, "--image")?;
        match (found, self.names.as_slice()) {
            (Some(name), _) => Ok(name),
            (None, [only]) => Ok(only.clone()),
            (None, _) => Err(self.missing(&format!("array named {}", FRAMES.join(", ")), "--image")),
        }
    }

    /// The arrays named, or the one of the usual names, if it holds no texts.
    fn chosen(
        &mut self,
        given: &[String],
        usual: &[&str],
        option: &str,
        layout: &FrameLayout,
    ) -> Result<Vec<ArrayRows>, ImportError> {
        if are_none(given) {
            return Ok(Vec::new());
        }
        let mut names = Vec::new();
        for name in given {
            names.extend(self.find(Some(name), &[], option)?);
        }
        if given.is_empty()
            && let Some(name) = self.find(None, usual, option)?
        {
            let place = self.place(&name);
            if holds_texts(self.entry(&name)?, &place)? {
                let note = format!("the array \"{name}\" holds texts, no numbers, so it was not imported");
                self.notes.push(note);
            } else {
                names.push(name);
            }
        }
        names.iter().map(|name| self.rows(name, layout)).collect()
    }

    fn times(
        &mut self,
        options: &ImportOptions,
        layout: &FrameLayout,
    ) -> Result<Option<(ArrayRows, f64)>, ImportError> {
        let Some(name) = self.find(options.time.as_ref(), &TIMES, "--time")? else {
            if options.rate_hz.is_some() {
                return Ok(None);
            }
            return Err(self.missing("array of timestamps, nor a rate", "--time, --rate"));
        };
        let rows = self.rows(&name, layout)?;
        match rows.width {
            1 => Ok(Some((rows, seconds_per_unit(&name)))),
            width => {
                let reason = format!("it has {width} numbers per frame; timestamps have one");
                Err(ImportError::record(self.place(&name), reason))
            }
        }
    }

    /// An array's file in the archive. Errors: `Record`.
    fn entry(&mut self, name: &str) -> Result<ZipFile<'_, File>, ImportError> {
        let place = self.place(name);
        let entry = self.archive.by_name(&format!("{name}.npy"));
        entry.map_err(|error| ImportError::record(place, error))
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
            let shape = &header.shape;
            let reason = format!("it has {found} bytes at most; its shape {shape:?} needs {needed}");
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
        let (shape, leading) = (&header.shape, &layout.leading);
        let Some(rest) = shape.strip_prefix(leading.as_slice()) else {
            return Err(wrong(format!(
                "its shape is {shape:?}; it must begin with {leading:?}, as that of the frames"
            )));
        };
        let bytes = header.bytes();
        let width = rest.iter().fold(1, |width: usize, side| width.saturating_mul(*side));
        if bytes.max(width as u64) > MAX_VALUES_BYTES {
            return Err(wrong(format!("its shape {shape:?} is too large")));
        }
        let mut content = Vec::new();
        let read = entry.take(bytes).read_to_end(&mut content);
        let found = read.map_err(|error| wrong(format!("it cannot be decompressed: {error}")))? as u64;
        if found != bytes {
            return Err(wrong(format!("it has {found} bytes; its shape needs {bytes}")));
        }
        let values = header.number.values(&content);
        match values.iter().position(|value| !(*value as f32).is_finite()) {
            Some(at) if values[at].is_finite() => Err(wrong(format!(
                "value {at} is {:e}; it is too large for a number of 32 bits, which is at most 3.4e38",
                values[at]
            ))),
            Some(at) => Err(wrong(format!(
                "value {at} is {}; it must be a finite number",
                values[at]
            ))),
            None => Ok(ArrayRows {
                name: name.to_owned(),
                values,
                width,
            }),
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
