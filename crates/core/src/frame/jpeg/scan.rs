//! Reads the blocks of one scan.

use std::ops::RangeInclusive;

use super::huffman::{BitError, BitReader, HuffmanTable};
use super::{ImageComponent, ImageLayout, JpegDamage, JpegTables, MAX_COEFFICIENT, standard};

/// A component of a scan.
#[derive(Debug)]
pub(super) struct ScanComponent {
    /// Its position in the frame header.
    pub(super) index: usize,
    pub(super) dc_table: usize,
    pub(super) ac_table: usize,
}

/// What a scan header says.
#[derive(Debug)]
pub(super) struct Scan {
    /// Counted from 1.
    pub(super) number: usize,
    pub(super) components: Vec<ScanComponent>,
    /// The coefficients of the scan, 0 to 63 in zigzag order.
    pub(super) band: RangeInclusive<usize>,
    /// Whether the scan adds a bit to coefficients of earlier scans.
    pub(super) is_refinement: bool,
    /// The position of the lowest bit of the scan's values.
    pub(super) low_bit: u32,
}

/// The blocks of one component in a unit (MCU) of the scan.
struct UnitPart<'a> {
    component: &'a mut ImageComponent,
    steps: &'a [u16; 64],
    dc: Option<&'a HuffmanTable>,
    ac: Option<&'a HuffmanTable>,
    /// Columns and rows of blocks in a unit.
    blocks: (usize, usize),
    /// Columns of blocks in the whole image.
    columns: usize,
    /// The first coefficient of the block before.
    last_dc: i32,
    /// Blocks that have no more coefficients in this scan.
    empty_blocks: u32,
}

impl Scan {
    /// Reads the data that starts at a position; gives the position of the marker after it. Errors: the data is damaged.
    pub(super) fn read(
        &self,
        layout: &mut ImageLayout,
        tables: &JpegTables,
        bytes: &[u8],
        start: usize,
    ) -> Result<usize, JpegDamage> {
        let (columns, rows) = self.units(layout);
        let mut parts = self.parts(layout, tables)?;
        let blocks_each: usize = parts.iter().map(|part| part.blocks.0 * part.blocks.1).sum();
        let unit_count = columns * rows;
        let mut reader = BitReader::new(bytes, start);
        let mut done = 0;
        for unit in 0..unit_count {
            if unit > 0 && tables.restart_interval > 0 && unit % tables.restart_interval == 0 {
                let at = self.end(&mut reader, &mut parts, done)?;
                let next = (unit / tables.restart_interval - 1) % 8;
                let at = after_restart(bytes, at, next).ok_or(JpegDamage::Restart {
                    scan: self.number,
                    block: done,
                })?;
                reader = BitReader::new(bytes, at);
            }
            for part in &mut parts {
                let (across, down) = part.blocks;
                for block in 0..across * down {
                    let column = (unit % columns) * across + block % across;
                    let row = (unit / columns) * down + block / across;
                    self.block(&mut reader, part, row * part.columns + column)
                        .map_err(|error| self.damage(&error, done, unit_count * blocks_each))?;
                    done += 1;
                }
            }
        }
        self.end(&mut reader, &mut parts, done)
    }

    /// Columns and rows of the units of this scan. A scan of one component has no blocks beyond the image.
    fn units(&self, layout: &ImageLayout) -> (usize, usize) {
        let only = match self.components.as_slice() {
            [only] => layout.components.get(only.index),
            _ => None,
        };
        let Some(component) = only else { return layout.units() };
        let (width, height) = layout.size;
        let (horizontal, vertical) = layout.max_sampling;
        (
            (width * component.sampling.0).div_ceil(8 * horizontal),
            (height * component.sampling.1).div_ceil(8 * vertical),
        )
    }

    /// Errors: `Segment` if a table is missing.
    fn parts<'a>(&self, layout: &'a mut ImageLayout, tables: &'a JpegTables) -> Result<Vec<UnitPart<'a>>, JpegDamage> {
        let (columns, rows) = layout.units();
        let is_alone = self.components.len() == 1;
        let is_first_band = *self.band.start() == 0;
        let mut parts = Vec::new();
        for (index, component) in layout.components.iter_mut().enumerate() {
            let Some(of_scan) = self.components.iter().find(|part| part.index == index) else {
                continue;
            };
            component.is_present |= is_first_band && !self.is_refinement;
            let (across, down) = component.sampling;
            if layout.is_progressive && component.nonzero.is_empty() {
                component.nonzero = vec![0; columns * across * rows * down];
            }
            let steps = tables.quantization.get(component.quantization).and_then(Option::as_ref);
            parts.push(UnitPart {
                steps: steps.ok_or(JpegDamage::Segment(0xdb))?,
                dc: table(&tables.dc, &*standard::DC, of_scan.dc_table),
                ac: table(&tables.ac, &*standard::AC, of_scan.ac_table),
                blocks: if is_alone { (1, 1) } else { (across, down) },
                columns: columns * across,
                last_dc: 0,
                empty_blocks: 0,
                component,
            });
        }
        Ok(parts)
    }

    fn block(&self, reader: &mut BitReader<'_>, part: &mut UnitPart<'_>, block: usize) -> Result<(), BitError> {
        let is_progressive = !part.component.nonzero.is_empty();
        match (is_progressive, *self.band.start(), self.is_refinement) {
            (false, ..) => {
                part.first_coefficient(reader, 0)?;
                part.sequential(reader)
            }
            (true, 0, false) => part.first_coefficient(reader, self.low_bit),
            (true, 0, true) => reader.bits(1).map(drop),
            (true, _, false) => part.band(reader, self, block),
            (true, _, true) => part.refined_band(reader, self, block),
        }
    }

    /// The position after a scan or restart interval, which must end with its last block.
    fn end(&self, reader: &mut BitReader<'_>, parts: &mut [UnitPart<'_>], done: usize) -> Result<usize, JpegDamage> {
        let has_blocks_left = parts.iter().any(|part| part.empty_blocks > 0);
        for part in parts {
            part.last_dc = 0;
        }
        let at = reader.end().filter(|_| !has_blocks_left);
        at.ok_or(JpegDamage::DataLeft {
            scan: self.number,
            block: done,
        })
    }

    fn damage(&self, error: &BitError, done: usize, expected: usize) -> JpegDamage {
        let (scan, block) = (self.number, done + 1);
        let part = match error {
            BitError::End => {
                return JpegDamage::MissingBlocks {
                    scan,
                    found: done,
                    expected,
                };
            }
            BitError::Code => "code",
            BitError::Coefficient => "coefficient",
        };
        JpegDamage::Value { scan, block, part }
    }
}

/// The table of the image, or else the standard one.
fn table<'a>(
    of_image: &'a [Option<HuffmanTable>],
    standard: &'a [Option<HuffmanTable>],
    index: usize,
) -> Option<&'a HuffmanTable> {
    let given = of_image.get(index)?.as_ref();
    given.or_else(|| standard.get(index)?.as_ref())
}

/// The position after the restart marker with that number; `None` if there is another or none.
fn after_restart(bytes: &[u8], at: usize, number: usize) -> Option<usize> {
    let rest = bytes.get(at..)?;
    let fill = rest.iter().take_while(|&&byte| byte == 0xff).count();
    let is_right = fill > 0 && rest.get(fill) == Some(&(0xd0 + number as u8));
    is_right.then_some(at + fill + 1)
}

impl UnitPart<'_> {
    /// The first coefficient of a block: the difference to that of the block before.
    fn first_coefficient(&mut self, reader: &mut BitReader<'_>, low_bit: u32) -> Result<(), BitError> {
        let bits = reader.symbol(self.dc.ok_or(BitError::Code)?)?;
        // A difference of 8-bit images has at most 11 bits.
        if bits > 11 {
            return Err(BitError::Code);
        }
        self.last_dc += reader.signed(u32::from(bits))?;
        self.check_range(0, self.last_dc, low_bit)
    }

    fn check_range(&self, index: usize, value: i32, low_bit: u32) -> Result<(), BitError> {
        let step = self.steps.get(index).map_or(1, |&step| u32::from(step));
        let size = value.unsigned_abs().saturating_mul(step) << low_bit.min(13);
        if size > MAX_COEFFICIENT + (step << low_bit.min(13)) {
            return Err(BitError::Coefficient);
        }
        Ok(())
    }

    /// The other coefficients of a block of a sequential image.
    fn sequential(&mut self, reader: &mut BitReader<'_>) -> Result<(), BitError> {
        let table = self.ac.ok_or(BitError::Code)?;
        let mut index = 1;
        while index < 64 {
            let symbol = reader.symbol(table)?;
            let (zeros, bits) = (usize::from(symbol >> 4), u32::from(symbol & 15));
            match (zeros, bits) {
                (15, 0) => index += 16,
                (0, 0) => return Ok(()),
                _ => {
                    index += zeros;
                    let value = reader.signed(bits)?;
                    if bits == 0 || index > 63 {
                        return Err(BitError::Code);
                    }
                    self.check_range(index, value, 0)?;
                    index += 1;
                }
            }
        }
        if index > 64 { Err(BitError::Code) } else { Ok(()) }
    }

    /// Coefficients of a block of a progressive image, for the first time.
    fn band(&mut self, reader: &mut BitReader<'_>, scan: &Scan, block: usize) -> Result<(), BitError> {
        if self.empty_blocks > 0 {
            self.empty_blocks -= 1;
            return Ok(());
        }
        let table = self.ac.ok_or(BitError::Code)?;
        let (mut index, last) = (*scan.band.start(), *scan.band.end());
        while index <= last {
            let symbol = reader.symbol(table)?;
            let (zeros, bits) = (usize::from(symbol >> 4), u32::from(symbol & 15));
            if bits == 0 && zeros < 15 {
                self.empty_blocks = (1 << zeros) - 1 + reader.bits(zeros as u32)?;
                return Ok(());
            }
            index += zeros;
            if bits > 0 {
                let value = reader.signed(bits)?;
                if index > last {
                    return Err(BitError::Code);
                }
                self.check_range(index, value, scan.low_bit)?;
                self.mark(block, index);
            }
            index += 1;
        }
        if index > last + 1 { Err(BitError::Code) } else { Ok(()) }
    }

    /// One more bit of the coefficients of a block of a progressive image.
    fn refined_band(&mut self, reader: &mut BitReader<'_>, scan: &Scan, block: usize) -> Result<(), BitError> {
        let table = self.ac.ok_or(BitError::Code)?;
        let (mut index, last) = (*scan.band.start(), *scan.band.end());
        while index <= last && self.empty_blocks == 0 {
            let symbol = reader.symbol(table)?;
            let (zeros, bits) = (usize::from(symbol >> 4), u32::from(symbol & 15));
            if bits == 0 && zeros < 15 {
                self.empty_blocks = (1 << zeros) + reader.bits(zeros as u32)?;
                break;
            }
            if bits > 1 {
                return Err(BitError::Code);
            }
            reader.bits(bits)?;
            index = self.refine_until(reader, block, (index, last), Some(zeros))?;
            if bits == 1 {
                if index > last {
                    return Err(BitError::Code);
                }
                self.mark(block, index);
            }
            index += 1;
        }
        if self.empty_blocks > 0 {
            self.empty_blocks -= 1;
            self.refine_until(reader, block, (index, last), None)?;
        }
        Ok(())
    }

    /// Reads a bit for each coefficient that is not 0, and skips the given number of zero coefficients; gives the index of the
    /// next zero.
    fn refine_until(
        &self,
        reader: &mut BitReader<'_>,
        block: usize,
        (mut index, last): (usize, usize),
        zeros: Option<usize>,
    ) -> Result<usize, BitError> {
        let nonzero = self.component.nonzero.get(block).copied().unwrap_or(0);
        let mut left = zeros;
        while index <= last {
            if nonzero >> index & 1 == 1 {
                reader.bits(1)?;
            } else {
                match &mut left {
                    Some(0) => break,
                    Some(left) => *left -= 1,
                    None => {}
                }
            }
            index += 1;
        }
        Ok(index)
    }

    fn mark(&mut self, block: usize, index: usize) {
        if let Some(nonzero) = self.component.nonzero.get_mut(block) {
            *nonzero |= 1 << index;
        }
    }
}
