//! The tables in effect: Huffman codes and quantization.

use std::sync::{Arc, LazyLock};

use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

/// The Huffman tables of ITU-T T.81, annex K.3, which Motion JPEG leaves out. The encoder writes them into every color image.
pub(super) static STANDARD: LazyLock<JpegTables> = LazyLock::new(|| {
    let mut image = Vec::new();
    JpegEncoder::new(&mut image)
        .encode(&[0; 3], 1, 1, ExtendedColorType::Rgb8)
        .expect("an image of one pixel that cannot be encoded is a bug");
    let tables = super::read(&image, JpegTables::default()).expect("an encoder of damaged images is a bug");
    JpegTables {
        huffman: tables.huffman,
        ..JpegTables::default()
    }
});

/// The tables in effect.
#[derive(Clone, Debug, Default)]
pub(super) struct JpegTables {
    /// Steps in zigzag order.
    pub(super) quantization: [Option<[u16; 64]>; 4],
    /// For first coefficients, and for all others.
    pub(super) huffman: [[Option<Arc<HuffmanTable>>; 4]; 2],
    /// Units between two restart markers; 0 for none.
    pub(super) restart_interval: usize,
}

impl JpegTables {
    /// Takes the tables of a segment; `None` if they are not valid.
    pub(super) fn read_quantization(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&head, rest)) = segment.split_first() {
            let bytes_each = usize::from(head >> 4) + 1;
            let (values, rest) = rest.split_at_checked(64 * bytes_each)?;
            let step = |index: usize| match bytes_each {
                1 => values.get(index).copied().map(u16::from),
                2 => number(values, 2 * index),
                _ => None,
            };
            step(0)?;
            *self.quantization.get_mut(usize::from(head & 15))? =
                Some(std::array::from_fn(|index| step(index).unwrap_or(0)));
            segment = rest;
        }
        Some(())
    }

    /// Takes the tables of a segment; `None` if they are not valid.
    pub(super) fn read_huffman(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&head, rest)) = segment.split_first() {
            let (counts, rest) = rest.split_first_chunk::<16>()?;
            let total = counts.iter().map(|&count| usize::from(count)).sum();
            let (symbols, rest) = rest.split_at_checked(total)?;
            let class = self.huffman.get_mut(usize::from(head >> 4))?;
            *class.get_mut(usize::from(head & 15))? = Some(Arc::new(HuffmanTable::new(*counts, symbols)?));
            segment = rest;
        }
        Some(())
    }
}

/// The two bytes at a position as a number.
pub(super) fn number(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().map(|pair| u16::from_be_bytes(*pair))
}

/// A Huffman table: which symbol each code stands for.
#[derive(Debug)]
pub(super) struct HuffmanTable {
    /// In rising order.
    codes: Vec<HuffmanCode>,
    /// For each first 8 bits that hold a whole code: its length and symbol; length 0 for longer codes.
    short: [(u8, u8); 256],
}

/// A code of 1 to 16 bits.
#[derive(Debug)]
struct HuffmanCode {
    /// One more than the largest 16 bits that begin with the code.
    end: u32,
    length: u8,
    symbol: u8,
}

impl HuffmanTable {
    /// From the number of codes of each length from 1 to 16 bits. `None` if there are more codes than bits.
    fn new(counts: [u8; 16], symbols: &[u8]) -> Option<Self> {
        let lengths = (1..).zip(counts);
        let lengths = lengths.flat_map(|(length, count)| std::iter::repeat_n(length, usize::from(count)));
        let mut end = 0;
        let code = |(length, &symbol): (u8, &u8)| {
            end += 0x1_0000 >> length;
            HuffmanCode { end, length, symbol }
        };
        let codes = lengths.zip(symbols).map(code).collect();
        let short = [(0, 0); 256];
        let mut table = Self { codes, short };
        for (bits, entry) in (0..=u8::MAX).zip(&mut table.short) {
            let found = search(&table.codes, u16::from(bits) << 8);
            *entry = found.filter(|(length, _)| *length <= 8).unwrap_or_default();
        }
        (end <= 0x1_0000).then_some(table)
    }

    /// Length and symbol of the code at the start of 16 bits.
    #[inline]
    pub(super) fn code(&self, bits: u16) -> Option<(u8, u8)> {
        match self.short[usize::from(bits >> 8)] {
            (0, _) => search(&self.codes, bits),
            found => Some(found),
        }
    }
}

fn search(codes: &[HuffmanCode], bits: u16) -> Option<(u8, u8)> {
    let position = codes.partition_point(|code| code.end <= u32::from(bits));
    codes.get(position).map(|code| (code.length, code.symbol))
}
