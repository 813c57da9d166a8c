//! Finds damage in JPEG images. Decoders repair what is missing or wrong with gray; a prediction from such a frame would
//! be wrong without notice. So the entropy-coded data of every scan is read to its end (ITU-T T.81): its codes must be
//! valid, its values in range, and it must hold exactly the blocks of the image.
//!
//! JPEG has no checksum. Damage cannot be found if the damaged data is itself a valid image of the same size, for
//! example after changed bits that only change a brightness, or in a progressive image that lacks its last scans but
//! has an end marker.

mod huffman;
mod scan;
mod standard;

use huffman::HuffmanTable;
use scan::{Scan, ScanComponent};

/// An image with more scans is refused: each costs time.
const MAX_SCANS: usize = 100;
/// The largest coefficient of an 8-bit image is 1024. Encoders that sharpen may exceed it.
const MAX_COEFFICIENT: u32 = 1280;

/// What is wrong with a JPEG image.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum JpegDamage {
    /// The bytes end too early.
    #[error("it ends before its end marker")]
    Truncated,
    /// There are other bytes where a marker must be.
    #[error("byte {0} is not the start of a marker")]
    Marker(usize),
    /// The content of a segment is not valid.
    #[error("its segment 0xff{0:02x} is not valid")]
    Segment(u8),
    /// A scan has fewer blocks than the image.
    #[error("scan {scan} ends after {found} of {expected} blocks")]
    MissingBlocks {
        /// Counted from 1.
        scan: usize,
        /// Blocks found.
        found: usize,
        /// Blocks of the scan.
        expected: usize,
    },
    /// Data is left after the last block of a scan or restart interval.
    #[error("scan {scan} has data left after block {block}")]
    DataLeft {
        /// Counted from 1.
        scan: usize,
        /// Counted from 1.
        block: usize,
    },
    /// A code or value that no encoder writes.
    #[error("scan {scan} has an invalid {part} in block {block}")]
    Value {
        /// Counted from 1.
        scan: usize,
        /// Counted from 1.
        block: usize,
        /// `code` or `coefficient`.
        part: &'static str,
    },
    /// A restart marker is missing or has the wrong number.
    #[error("scan {scan} has no restart marker after block {block}")]
    Restart {
        /// Counted from 1.
        scan: usize,
        /// Counted from 1.
        block: usize,
    },
    /// A component of the image is in no scan.
    #[error("{0} of its color components has no data")]
    MissingComponent(usize),
    /// Not baseline, extended or progressive with 8 bits and Huffman codes.
    #[error("it is of a kind that is not supported; write it as baseline or progressive JPEG with 8 bits")]
    Unsupported,
}

/// One color component of the image.
#[derive(Debug)]
struct ImageComponent {
    id: u8,
    /// Horizontal and vertical sampling factor, 1 to 4.
    sampling: (usize, usize),
    quantization: usize,
    /// Whether a scan held its first data.
    is_present: bool,
    /// Of a progressive image: for each block, a bit for each coefficient that is not 0.
    nonzero: Vec<u64>,
}

/// The frame header.
#[derive(Debug)]
struct ImageLayout {
    is_progressive: bool,
    /// Width and height in pixels.
    size: (usize, usize),
    /// The largest sampling factors.
    max_sampling: (usize, usize),
    components: Vec<ImageComponent>,
}

impl ImageLayout {
    /// Columns and rows of the units (MCU) of a scan with several components.
    fn units(&self) -> (usize, usize) {
        let (width, height) = self.size;
        let (horizontal, vertical) = self.max_sampling;
        (width.div_ceil(8 * horizontal), height.div_ceil(8 * vertical))
    }
}

/// The tables in effect.
#[derive(Debug, Default)]
struct JpegTables {
    /// Steps in zigzag order.
    quantization: [Option<[u16; 64]>; 4],
    /// For first coefficients.
    dc: [Option<HuffmanTable>; 4],
    /// For all other coefficients.
    ac: [Option<HuffmanTable>; 4],
    /// Units between two restart markers; 0 for none.
    restart_interval: usize,
}

/// Errors: the image is damaged. Pixels are not computed. Takes memory only for progressive images: 8 bytes a block.
pub(super) fn check(bytes: &[u8]) -> Result<(), JpegDamage> {
    let mut reader = SegmentReader { bytes, at: 0 };
    let (mut tables, mut layout, mut scans) = (JpegTables::default(), None, 0);
    if reader.marker()? != 0xd8 {
        return Err(JpegDamage::Marker(0));
    }
    loop {
        match reader.marker()? {
            0xc0..=0xc2 if layout.is_some() => return Err(JpegDamage::Segment(0xc0)),
            marker @ 0xc0..=0xc2 => layout = Some(read_layout(marker, reader.segment()?)?),
            0xc4 => read_huffman(&mut tables, reader.segment()?).ok_or(JpegDamage::Segment(0xc4))?,
            0xc3 | 0xc5..=0xcf => return Err(JpegDamage::Unsupported),
            0xdb => read_quantization(&mut tables, reader.segment()?).ok_or(JpegDamage::Segment(0xdb))?,
            0xdd => {
                let segment = reader.segment()?;
                tables.restart_interval = usize::from(number(segment, 0).ok_or(JpegDamage::Segment(0xdd))?);
            }
            0xda => {
                let layout = layout.as_mut().ok_or(JpegDamage::Segment(0xda))?;
                scans += 1;
                let header = reader.segment()?;
                let scan = scan_of(header, layout, scans).filter(|_| scans <= MAX_SCANS);
                let scan = scan.ok_or(JpegDamage::Segment(0xda))?;
                reader.at = scan.read(layout, &tables, bytes, reader.at)?;
            }
            0xd9 => break,
            marker @ (0x00..=0x01 | 0xd0..=0xd8) => return Err(JpegDamage::Segment(marker)),
            _ => drop(reader.segment()?),
        }
    }
    let layout = layout.ok_or(JpegDamage::Segment(0xc0))?;
    let missing = layout.components.iter().filter(|part| !part.is_present).count();
    if missing > 0 {
        return Err(JpegDamage::MissingComponent(missing));
    }
    Ok(())
}

/// Reads markers and segments, but not the data of scans.
struct SegmentReader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> SegmentReader<'a> {
    /// The second byte of the next marker. Errors: `Truncated`, `Marker`.
    fn marker(&mut self) -> Result<u8, JpegDamage> {
        if *self.bytes.get(self.at).ok_or(JpegDamage::Truncated)? != 0xff {
            return Err(JpegDamage::Marker(self.at));
        }
        // A marker may begin with several of these bytes.
        while *self.bytes.get(self.at).ok_or(JpegDamage::Truncated)? == 0xff {
            self.at += 1;
        }
        self.at += 1;
        self.bytes.get(self.at - 1).copied().ok_or(JpegDamage::Truncated)
    }

    /// The content of a segment, after its length. Errors: `Truncated`.
    fn segment(&mut self) -> Result<&'a [u8], JpegDamage> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = usize::from(number(rest, 0).ok_or(JpegDamage::Truncated)?);
        let content = rest.get(2..length).ok_or(JpegDamage::Truncated)?;
        self.at += length;
        Ok(content)
    }
}

/// The two bytes at a position as a number.
fn number(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().map(|pair| u16::from_be_bytes(*pair))
}

fn read_layout(marker: u8, segment: &[u8]) -> Result<ImageLayout, JpegDamage> {
    const DAMAGED: JpegDamage = JpegDamage::Segment(0xc0);
    if *segment.first().ok_or(DAMAGED)? != 8 {
        return Err(JpegDamage::Unsupported);
    }
    let (height, width) = number(segment, 1).zip(number(segment, 3)).ok_or(DAMAGED)?;
    let count = usize::from(*segment.get(5).ok_or(DAMAGED)?);
    let parts = segment.get(6..6 + 3 * count).ok_or(DAMAGED)?;
    let components: Vec<ImageComponent> = parts
        .as_chunks::<3>()
        .0
        .iter()
        .map(|&[id, sampling, quantization]| ImageComponent {
            id,
            sampling: (usize::from(sampling >> 4), usize::from(sampling & 15)),
            quantization: usize::from(quantization),
            is_present: false,
            nonzero: Vec::new(),
        })
        .collect();
    let is_sampled = |part: &ImageComponent| (1..=4).contains(&part.sampling.0) && (1..=4).contains(&part.sampling.1);
    let max_horizontal = components.iter().map(|part| part.sampling.0).max();
    let max_vertical = components.iter().map(|part| part.sampling.1).max();
    let max_sampling = max_horizontal.zip(max_vertical).ok_or(DAMAGED)?;
    if width == 0 || height == 0 || count > 4 || !components.iter().all(is_sampled) {
        return Err(DAMAGED);
    }
    Ok(ImageLayout {
        is_progressive: marker == 0xc2,
        size: (usize::from(width), usize::from(height)),
        max_sampling,
        components,
    })
}

fn read_quantization(tables: &mut JpegTables, mut segment: &[u8]) -> Option<()> {
    while let Some((&head, rest)) = segment.split_first() {
        let bytes_each = usize::from(head >> 4) + 1;
        let values = rest.get(..64 * bytes_each).filter(|_| bytes_each <= 2)?;
        let step = |index: usize| match bytes_each {
            1 => values.get(index).copied().map_or(0, u16::from),
            _ => number(values, 2 * index).unwrap_or(0),
        };
        *tables.quantization.get_mut(usize::from(head & 15))? = Some(std::array::from_fn(step));
        segment = rest.get(64 * bytes_each..)?;
    }
    Some(())
}

fn read_huffman(tables: &mut JpegTables, mut segment: &[u8]) -> Option<()> {
    while let Some((&head, rest)) = segment.split_first() {
        let counts: [u8; 16] = *rest.first_chunk()?;
        let total = counts.iter().map(|&count| usize::from(count)).sum::<usize>();
        let symbols = rest.get(16..16 + total)?;
        let class = match head >> 4 {
            0 => &mut tables.dc,
            1 => &mut tables.ac,
            _ => return None,
        };
        *class.get_mut(usize::from(head & 15))? = Some(HuffmanTable::new(counts, symbols)?);
        segment = rest.get(16 + total..)?;
    }
    Some(())
}

/// The scan that a header describes; `None` if it is not valid for the image.
fn scan_of(header: &[u8], layout: &ImageLayout, scan: usize) -> Option<Scan> {
    let (&count, rest) = header.split_first()?;
    let count = usize::from(count);
    let (parts, rest) = rest.split_at_checked(2 * count)?;
    let (&[first, last, bits], _) = rest.split_first_chunk()?;
    let components: Option<Vec<ScanComponent>> = parts
        .as_chunks::<2>()
        .0
        .iter()
        .map(|&[id, tables]| {
            Some(ScanComponent {
                index: layout.components.iter().position(|part| part.id == id)?,
                dc_table: usize::from(tables >> 4),
                ac_table: usize::from(tables & 15),
            })
        })
        .collect();
    let (components, first, last) = (components?, usize::from(first), usize::from(last));
    let is_valid = if layout.is_progressive {
        // Coefficients of several components are never mixed, except the first of each block.
        first <= last && last <= 63 && (first > 0 || last == 0) && (first == 0 || count == 1) && bits & 15 <= 13
    } else {
        (first, last, bits) == (0, 63, 0)
    };
    // A scan has its components in the order of the frame header, each once.
    let is_ordered = components.is_sorted_by(|before, after| before.index < after.index);
    let is_valid = is_valid && is_ordered && count > 0;
    is_valid.then_some(Scan {
        number: scan,
        components,
        band: first..=last,
        is_refinement: bits >> 4 > 0,
        low_bit: u32::from(bits & 15),
    })
}
