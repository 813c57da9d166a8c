//! Finds damage in JPEG images. Decoders repair what is missing or wrong with gray; a prediction from such a frame would
//! be wrong without notice. So the entropy-coded data of every scan is read to its end (ITU-T T.81): its codes must be
//! valid, its values in range, and it must hold exactly the blocks of the image. `zune-jpeg` in its strict mode does not do
//! that: it accepts a scan that ends too early before an end marker, and most scans with 30 changed bytes.
//!
//! JPEG has no checksum. Damage cannot be found if the damaged data is itself a valid image of the same size, for
//! example after changed bits that only change a brightness, or in a progressive image that lacks its last scans but
//! has an end marker.

mod layout;
mod reader;
mod scan;
mod tables;

use layout::ImageLayout;
use reader::JpegReader;
use scan::Scan;
use tables::{JpegTables, number};

/// An image with more scans is refused: each costs time.
const MAX_SCANS: usize = 100;

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
    /// The data of a scan ends too early or too late, or holds what no encoder writes.
    #[error("scan {scan} has {found} block {block}")]
    Scan {
        /// Counted from 1.
        scan: usize,
        /// Counted from 1.
        block: usize,
        /// What is wrong.
        found: ScanDamage,
    },
    /// A component of the image is in no scan.
    #[error("{0} of its color components has no data")]
    MissingComponent(usize),
    /// Not baseline, extended or progressive with 8 bits and Huffman codes.
    #[error("it is of a kind that is not supported; write it as baseline or progressive JPEG with 8 bits")]
    Unsupported,
}

/// What is wrong with the data of a scan, as the message says it before the block.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ScanDamage {
    /// The data ends before the block does.
    #[error("no data for")]
    End,
    /// The bits are no code, or a code that has no meaning here.
    #[error("an invalid code in")]
    Code,
    /// A value is larger than any image has.
    #[error("an invalid coefficient in")]
    Coefficient,
    /// The last block of the scan or of a restart interval is not the end of its data.
    #[error("data left after")]
    DataLeft,
    /// A restart marker is missing or has the wrong number.
    #[error("no restart marker after")]
    Restart,
}

/// Errors: the image is damaged. Pixels are not computed. Takes memory only for progressive images: 8 bytes a block.
pub(super) fn check(bytes: &[u8]) -> Result<(), JpegDamage> {
    read(bytes, tables::STANDARD.clone()).map(drop)
}

/// The tables in effect at the end of an image that starts with the given ones.
fn read(bytes: &[u8], mut tables: JpegTables) -> Result<JpegTables, JpegDamage> {
    let mut reader = JpegReader::new(bytes);
    let (mut layout, mut scans) = (None, 0);
    if reader.marker()? != 0xd8 {
        return Err(JpegDamage::Marker(0));
    }
    loop {
        let marker = reader.marker()?;
        let damaged = JpegDamage::Segment(marker);
        let segment = match marker {
            0xd9 => break,
            0x00..=0x01 | 0xd0..=0xd8 => return Err(damaged),
            0xc3 | 0xc5..=0xcf => return Err(JpegDamage::Unsupported),
            _ => reader.segment()?,
        };
        match marker {
            0xc0..=0xc2 if layout.is_some() => return Err(damaged),
            0xc0..=0xc2 if segment.first() != Some(&8) => return Err(JpegDamage::Unsupported),
            0xc0..=0xc2 => layout = Some(ImageLayout::new(segment, marker == 0xc2).ok_or(damaged)?),
            0xc4 => tables.read_huffman(segment).ok_or(damaged)?,
            0xdb => tables.read_quantization(segment).ok_or(damaged)?,
            0xdd => tables.restart_interval = usize::from(number(segment, 0).ok_or(damaged)?),
            0xda => {
                scans += 1;
                let layout = layout.as_mut().filter(|_| scans <= MAX_SCANS);
                let scan = layout.and_then(|layout| Scan::new(segment, layout, &tables));
                scan.ok_or(damaged)?.read(&mut reader, scans)?;
            }
            _ => {}
        }
    }
    let layout = layout.ok_or(JpegDamage::Segment(0xc0))?;
    match layout.components.iter().filter(|part| !part.is_present).count() {
        0 => Ok(tables),
        missing => Err(JpegDamage::MissingComponent(missing)),
    }
}
