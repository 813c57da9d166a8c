//! Huffman codes and the bits of a scan.

/// A Huffman table: which symbol each code stands for.
#[derive(Clone, Debug)]
pub(super) struct HuffmanTable {
    /// For each first 8 bits that hold a whole code: its length and symbol; length 0 for longer codes.
    short: Box<[(u8, u8); 256]>,
    /// For each length from 1 to 16 bits: one more than the largest code, left-aligned in 16 bits.
    ends: [u32; 16],
    /// For each length: the position of its first symbol, and its first code.
    firsts: [(u32, u32); 16],
    symbols: Vec<u8>,
}

impl HuffmanTable {
    /// From the number of codes of each length from 1 to 16 bits. `None` if there are more codes than bits.
    pub(super) fn new(counts: [u8; 16], symbols: &[u8]) -> Option<Self> {
        let (mut ends, mut firsts) = ([0; 16], [(0, 0); 16]);
        let (mut code, mut position) = (0_u32, 0_u32);
        for (length, ((&count, end), first)) in (1_u32..).zip(counts.iter().zip(&mut ends).zip(&mut firsts)) {
            *first = (position, code);
            code += u32::from(count);
            position += u32::from(count);
            if code > 1 << length {
                return None;
            }
            *end = code << (16 - length);
            code <<= 1;
        }
        let mut table = Self {
            short: Box::new([(0, 0); 256]),
            ends,
            firsts,
            symbols: symbols.to_vec(),
        };
        let mut short = [(0, 0); 256];
        for (bits, entry) in (0_u32..).zip(&mut short) {
            *entry = table
                .search(bits << 8)
                .filter(|(length, _)| *length <= 8)
                .unwrap_or((0, 0));
        }
        *table.short = short;
        Some(table)
    }

    /// The length and the symbol of the code at the start of 16 bits.
    fn lookup(&self, bits: u32) -> Option<(u8, u8)> {
        match self.short.get(bits as usize >> 8) {
            Some(&(length, symbol)) if length > 0 => Some((length, symbol)),
            _ => self.search(bits),
        }
    }

    fn search(&self, bits: u32) -> Option<(u8, u8)> {
        let index = self.ends.iter().position(|&end| bits < end)?;
        let (position, code) = *self.firsts.get(index)?;
        let offset = (bits >> (15 - index)).checked_sub(code)?;
        Some((index as u8 + 1, *self.symbols.get((position + offset) as usize)?))
    }
}

/// Why no symbol could be read.
#[derive(Debug)]
pub(super) enum BitError {
    /// No bits are left before the next marker or the end.
    End,
    /// The bits are no code, or a code that has no meaning here.
    Code,
    /// The value is larger than any image has.
    Coefficient,
}

/// Reads the bits of entropy-coded data up to the next marker.
pub(super) struct BitReader<'a> {
    bytes: &'a [u8],
    at: usize,
    /// The next bits, left-aligned.
    buffer: u64,
    count: u32,
}

impl<'a> BitReader<'a> {
    pub(super) fn new(bytes: &'a [u8], at: usize) -> Self {
        Self {
            bytes,
            at,
            buffer: 0,
            count: 0,
        }
    }

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

    fn drop_bits(&mut self, count: u32) -> Result<(), BitError> {
        self.count = self.count.checked_sub(count).ok_or(BitError::End)?;
        self.buffer <<= count;
        Ok(())
    }

    /// The next 0 to 16 bits as a number. Errors: `End`.
    pub(super) fn bits(&mut self, count: u32) -> Result<u32, BitError> {
        if count == 0 {
            return Ok(0);
        }
        if self.count < count {
            self.fill();
        }
        let value = (self.buffer >> (64 - count)) as u32;
        self.drop_bits(count)?;
        Ok(value)
    }

    /// The next symbol. Errors: `End`, `Code`.
    pub(super) fn symbol(&mut self, table: &HuffmanTable) -> Result<u8, BitError> {
        if self.count < 16 {
            self.fill();
        }
        let is_short = self.count < 16;
        let found = table.lookup((self.buffer >> 48) as u32);
        let (length, symbol) = found.ok_or(if is_short { BitError::End } else { BitError::Code })?;
        self.drop_bits(u32::from(length))?;
        Ok(symbol)
    }

    /// A signed value of 0 to 16 bits. Errors: `End`.
    pub(super) fn signed(&mut self, bits: u32) -> Result<i32, BitError> {
        let value = self.bits(bits)? as i32;
        let is_negative = bits > 0 && value < 1 << (bits - 1);
        Ok(if is_negative { value - (1 << bits) + 1 } else { value })
    }

    /// The position after the last byte, if at most the padding of that byte is left.
    pub(super) fn end(&mut self) -> Option<usize> {
        self.fill();
        (self.count < 8).then_some(self.at)
    }
}
