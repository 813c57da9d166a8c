//! The frame header: size and color components of the image.

use super::tables::number;

/// One color component of the image.
#[derive(Debug)]
pub(super) struct ImageComponent {
    pub(super) id: u8,
    /// Horizontal and vertical sampling factor, 1 to 4: columns and rows of blocks in a unit.
    pub(super) sampling: (usize, usize),
    /// The number of its quantization table.
    pub(super) quantization: usize,
    /// Columns and rows of the blocks that hold pixels of the image.
    pub(super) blocks: (usize, usize),
    /// Whether a scan held its first data.
    pub(super) is_present: bool,
    /// In a progressive image: for each block, a bit for each coefficient that is not 0.
    pub(super) nonzero: Vec<u64>,
}

/// The frame header.
#[derive(Debug)]
pub(super) struct ImageLayout {
    pub(super) is_progressive: bool,
    /// Columns and rows of the units (MCU) of a scan with several components.
    pub(super) units: (usize, usize),
    pub(super) components: Vec<ImageComponent>,
}

impl ImageLayout {
    /// From the content of the segment; `None` if it is not valid.
    pub(super) fn new(segment: &[u8], is_progressive: bool) -> Option<Self> {
        let (height, width) = (usize::from(number(segment, 1)?), usize::from(number(segment, 3)?));
        let count = usize::from(*segment.get(5)?);
        let parts = segment.get(6..6 + 3 * count)?.as_chunks::<3>().0;
        let sampling = |part: &[u8; 3]| (usize::from(part[1] >> 4), usize::from(part[1] & 15));
        let factors = || parts.iter().map(sampling);
        let is_sampled = factors().all(|(across, down)| (1..=4).contains(&across) && (1..=4).contains(&down));
        if width == 0 || height == 0 || count > 4 || !is_sampled {
            return None;
        }
        let unit_width = 8 * factors().map(|(across, _)| across).max()?;
        let unit_height = 8 * factors().map(|(_, down)| down).max()?;
        let units = (width.div_ceil(unit_width), height.div_ceil(unit_height));
        let component = |part: &[u8; 3]| {
            let (across, down) = sampling(part);
            let block_count = units.0 * across * units.1 * down;
            ImageComponent {
                id: part[0],
                sampling: (across, down),
                quantization: usize::from(part[2]),
                blocks: (
                    (width * across).div_ceil(unit_width),
                    (height * down).div_ceil(unit_height),
                ),
                is_present: false,
                nonzero: vec![0; if is_progressive { block_count } else { 0 }],
            }
        };
        Some(Self {
            is_progressive,
            units,
            components: parts.iter().map(component).collect(),
        })
    }
}
