//! Reads markers, segments and the bits of scans.

use super::tables::{HuffmanTable, number};
use super::{JpegDamage, ScanDamage};

/// Reads an image from its start.
pub(super) struct JpegReader<'a> {
    bytes: &'a [u8],
    at: usize,
    /// The next bits of a scan, left-aligned.
    buffer: u64,
    count: u32,
}

impl<'a> JpegReader<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            at: 0,
            buffer: 0,
            count: 0,
        }
    }

    /// The second byte of the next marker. Errors: `Truncated`, `Marker`.
    pub(super) fn marker(&mut self) -> Result<u8, JpegDamage> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        // A marker may begin with several of these bytes.
        let fill = rest.iter().take_while(|&&byte| byte == 0xff).count();
        let &marker = rest.get(fill).ok_or(JpegDamage::Truncated)?;
        if fill == 0 {
            return Err(JpegDamage::Marker(self.at));
        }
        self.at += fill + 1;
        Ok(marker)
    }

    /// The content of a segment, after its length. Errors: `Truncated`.
    pub(super) fn segment(&mut self) -> Result<&'a [u8], JpegDamage> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = usize::from(number(rest, 0).ok_or(JpegDamage::Truncated)?);
        self.at += length;
        rest.get(2..length).ok_or(JpegDamage::Truncated)
    }

    #[inline]
    fn fill(&mut self) {
        while self.count <= 56 {
            let Some(&byte) = self.bytes.get(self.at) else { return };
            if byte == 0xff && self.bytes.get(self.at + 1) != Some(&0) {
                return;
            }
            self.at += if byte == 0xff { 2 } else { 1 };
            self.buffer |= u64::from(byte) << (56 - self.count);
            self.count += 8;
        }
    }

    #[inline]
    fn drop_bits(&mut self, count: u32) -> Result<(), ScanDamage> {
        self.count = self.count.checked_sub(count).ok_or(ScanDamage::End)?;
        self.buffer <<= count;
        Ok(())
    }

    /// The next 0 to 16 bits of a scan as a number. Errors: `End`.
    #[inline]
    pub(super) fn bits(&mut self, count: u32) -> Result<u32, ScanDamage> {
        if self.count < count {
            self.fill();
        }
        let value = self.buffer.checked_shr(64 - count).unwrap_or(0) as u32;
        self.drop_bits(count)?;
        Ok(value)
    }

    /// The next symbol of a scan. Errors: `End`, `Code`.
    #[inline]
    pub(super) fn symbol(&mut self, table: &HuffmanTable) -> Result<u8, ScanDamage> {
        if self.count < 16 {
            self.fill();
        }
        let code = table.code((self.buffer >> 48) as u16);
        let missing = if self.count < 16 {
            ScanDamage::End
        } else {
            ScanDamage::Code
        };
        let (length, symbol) = code.ok_or(missing)?;
        self.drop_bits(u32::from(length))?;
        Ok(symbol)
    }

    /// A signed value of 0 to 16 bits. Errors: `End`.
    #[inline]
    pub(super) fn signed(&mut self, bits: u32) -> Result<i32, ScanDamage> {
        let value = self.bits(bits)? as i32;
        let is_negative = bits > 0 && value < 1 << (bits - 1);
        Ok(if is_negative { value - (1 << bits) + 1 } else { value })
    }

    /// Ends the data of a scan or restart interval. Whether at most the padding of its last byte was left.
    pub(super) fn end_bits(&mut self) -> bool {
        self.fill();
        self.buffer = 0;
        std::mem::take(&mut self.count) < 8
    }
}
