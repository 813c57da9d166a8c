//! Reads the blocks of one scan.

use super::layout::{ImageComponent, ImageLayout};
use super::reader::JpegReader;
use super::tables::{HuffmanTable, JpegTables};
use super::{JpegDamage, ScanDamage};

/// The largest coefficient of an 8-bit image is 1024. Encoders that sharpen may exceed it.
const MAX_COEFFICIENT: u64 = 1280;

/// A scan, as its header describes it.
pub(super) struct Scan<'a> {
    parts: Vec<ScanPart<'a>>,
    band: Band,
    /// Columns and rows of units (MCU).
    units: (usize, usize),
    restart_interval: usize,
}

/// The coefficients of each block that a scan holds.
#[derive(Clone, Copy)]
struct Band {
    /// In zigzag order, 0 to 63.
    first: usize,
    last: usize,
    /// Whether the scan adds a bit to coefficients of earlier scans.
    is_refinement: bool,
    /// The position of the lowest bit of the scan's values.
    low_bit: u32,
    is_progressive: bool,
}

/// A component in a scan.
struct ScanPart<'a> {
    component: &'a mut ImageComponent,
    steps: &'a [u16; 64],
    dc: Option<&'a HuffmanTable>,
    ac: Option<&'a HuffmanTable>,
    /// Columns and rows of blocks in a unit of the scan.
    blocks: (usize, usize),
    /// Columns of blocks in the whole image.
    columns: usize,
    /// The first coefficient of the block before.
    last_dc: i32,
    /// Blocks that have no more coefficients in this scan.
    empty_blocks: u32,
}

impl<'a> Scan<'a> {
    /// From the content of the header's segment; `None` if it is not valid for the image.
    pub(super) fn new(header: &[u8], layout: &'a mut ImageLayout, tables: &'a JpegTables) -> Option<Self> {
        let (&count, rest) = header.split_first()?;
        let (ids, rest) = rest.split_at_checked(2 * usize::from(count))?;
        let (&[first, last, bits], _) = rest.split_first_chunk()?;
        let band = Band {
            first: usize::from(first),
            last: usize::from(last),
            is_refinement: bits >> 4 > 0,
            low_bit: u32::from(bits & 15),
            is_progressive: layout.is_progressive,
        };
        let is_valid = if layout.is_progressive {
            // Coefficients of several components are never mixed, except the first of each block.
            let is_unmixed = if first == 0 { last == 0 } else { count == 1 };
            is_unmixed && first <= last && last <= 63 && band.low_bit <= 13
        } else {
            (first, last, bits) == (0, 63, 0)
        };
        // A scan has its components in the order of the frame header, each once.
        let mut components = layout.components.iter_mut();
        let parts: Option<Vec<ScanPart<'a>>> = ids
            .as_chunks::<2>()
            .0
            .iter()
            .map(|&[id, table]| {
                let component = components.find(|component| component.id == id)?;
                component.is_present |= first == 0 && !band.is_refinement;
                let huffman = |class: usize, index: u8| tables.huffman[class].get(usize::from(index))?.as_deref();
                Some(ScanPart {
                    steps: tables.quantization.get(component.quantization)?.as_ref()?,
                    dc: huffman(0, table >> 4),
                    ac: huffman(1, table & 15),
                    blocks: if count == 1 { (1, 1) } else { component.sampling },
                    columns: layout.units.0 * component.sampling.0,
                    last_dc: 0,
                    empty_blocks: 0,
                    component,
                })
            })
            .collect();
        let parts = parts.filter(|parts| is_valid && !parts.is_empty())?;
        let units = match parts.as_slice() {
            // A scan of one component has no blocks beyond the image.
            [only] => only.component.blocks,
            _ => layout.units,
        };
        Some(Self {
            parts,
            band,
            units,
            restart_interval: tables.restart_interval,
        })
    }

    /// Reads the data. `number`: counted from 1. Errors: the data is damaged.
    pub(super) fn read(mut self, reader: &mut JpegReader<'_>, number: usize) -> Result<(), JpegDamage> {
        let mut done = 0;
        let damage = |found, block| JpegDamage::Scan {
            scan: number,
            block,
            found,
        };
        for unit in 0..self.units.0 * self.units.1 {
            if unit > 0 && self.restart_interval > 0 && unit % self.restart_interval == 0 {
                self.end_interval(reader).map_err(|found| damage(found, done))?;
                let marker = 0xd0 + (unit / self.restart_interval - 1) % 8;
                if reader.marker().map(usize::from) != Ok(marker) {
                    return Err(damage(ScanDamage::Restart, done));
                }
            }
            for part in &mut self.parts {
                let (across, down) = part.blocks;
                for block in 0..across * down {
                    let column = (unit % self.units.0) * across + block % across;
                    let row = (unit / self.units.0) * down + block / across;
                    done += 1;
                    part.read_block(reader, self.band, row * part.columns + column)
                        .map_err(|found| damage(found, done))?;
                }
            }
        }
        self.end_interval(reader).map_err(|found| damage(found, done))
    }

    /// A scan or restart interval must end with its last block.
    fn end_interval(&mut self, reader: &mut JpegReader<'_>) -> Result<(), ScanDamage> {
        let has_blocks_left = self.parts.iter().any(|part| part.empty_blocks > 0);
        for part in &mut self.parts {
            part.last_dc = 0;
        }
        let is_ended = reader.end_bits() && !has_blocks_left;
        is_ended.then_some(()).ok_or(ScanDamage::DataLeft)
    }
}

impl ScanPart<'_> {
    /// Reads what the scan holds of a block. Errors: what is wrong with it.
    fn read_block(&mut self, reader: &mut JpegReader<'_>, band: Band, block: usize) -> Result<(), ScanDamage> {
        if band.first == 0 && band.is_refinement {
            reader.bits(1)?;
        } else if band.first == 0 {
            self.read_first_coefficient(reader, band.low_bit)?;
        }
        if band.last > 0 {
            self.read_other_coefficients(reader, band, block)?;
        }
        Ok(())
    }

    /// The first coefficient of a block is the difference to that of the block before.
    fn read_first_coefficient(&mut self, reader: &mut JpegReader<'_>, low_bit: u32) -> Result<(), ScanDamage> {
        let bits = reader.symbol(self.dc.ok_or(ScanDamage::Code)?)?;
        // A difference of 8-bit images has at most 11 bits.
        if bits > 11 {
            return Err(ScanDamage::Code);
        }
        self.last_dc += reader.signed(u32::from(bits))?;
        self.check_range(0, self.last_dc, low_bit)
    }

    fn read_other_coefficients(
        &mut self,
        reader: &mut JpegReader<'_>,
        band: Band,
        block: usize,
    ) -> Result<(), ScanDamage> {
        let nonzero = self.component.nonzero.get(block).copied();
        let nonzero = nonzero.filter(|_| band.is_refinement).unwrap_or(0);
        let mut index = band.first.max(1);
        while index <= band.last && self.empty_blocks == 0 {
            let symbol = reader.symbol(self.ac.ok_or(ScanDamage::Code)?)?;
            let (zeros, bits) = (u32::from(symbol >> 4), u32::from(symbol & 15));
            if bits == 0 && zeros < 15 {
                self.empty_blocks = (1 << zeros) + reader.bits(zeros)?;
                break;
            }
            let value = reader.signed(bits)?;
            index = match nonzero {
                0 => index + zeros as usize,
                _ => pass_zeros(reader, nonzero, (index, band.last), zeros as usize)?,
            };
            if index > band.last || (band.is_refinement && bits > 1) {
                return Err(ScanDamage::Code);
            }
            if bits > 0 {
                self.check_range(index, value, band.low_bit)?;
                if let Some(nonzero) = self.component.nonzero.get_mut(block) {
                    *nonzero |= 1 << index;
                }
            }
            index += 1;
        }
        // Only progressive images have codes for several blocks without more coefficients.
        if self.empty_blocks > 1 && !band.is_progressive {
            return Err(ScanDamage::Code);
        }
        if self.empty_blocks > 0 {
            self.empty_blocks -= 1;
            pass_zeros(reader, nonzero, (index, band.last), 64)?;
        }
        Ok(())
    }

    fn check_range(&self, index: usize, value: i32, low_bit: u32) -> Result<(), ScanDamage> {
        let step = self.steps.get(index).map_or(1, |&step| u64::from(step)) << low_bit;
        let is_in_range = u64::from(value.unsigned_abs()) * step <= MAX_COEFFICIENT + step;
        is_in_range.then_some(()).ok_or(ScanDamage::Coefficient)
    }
}

/// Reads one bit for each coefficient in `nonzero`, and skips a given number of zero coefficients. Gives the index of the
/// zero coefficient after them.
fn pass_zeros(
    reader: &mut JpegReader<'_>,
    nonzero: u64,
    (mut index, last): (usize, usize),
    mut zeros: usize,
) -> Result<usize, ScanDamage> {
    while index <= last && nonzero >> index != 0 {
        if nonzero >> index & 1 == 1 {
            reader.bits(1)?;
        } else if zeros == 0 {
            return Ok(index);
        } else {
            zeros -= 1;
        }
        index += 1;
    }
    Ok(index + zeros)
}
