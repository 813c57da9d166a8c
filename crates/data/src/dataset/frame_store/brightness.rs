//! Frames in another light: every intensity times a factor, limited to white.

/// A factor of brightness, with what becomes of each intensity.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::dataset) struct Brightness {
    pub(in crate::dataset) factor: f64,
    changed: [u8; 256],
}

impl Brightness {
    pub(in crate::dataset) fn new(factor: f64) -> Self {
        Self {
            factor,
            changed: std::array::from_fn(|intensity| (intensity as f64 * factor).round().min(255.0) as u8),
        }
    }

    /// These intensities with the factor.
    pub(in crate::dataset) fn of(&self, pixels: &[u8]) -> Vec<u8> {
        pixels.iter().map(|&pixel| self.changed[usize::from(pixel)]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intensities_are_multiplied_and_limited_to_white() {
        assert_eq!(Brightness::new(0.5).of(&[0, 3, 100, 255]), [0, 2, 50, 128]);
        assert_eq!(Brightness::new(3.0).of(&[0, 3, 85, 86, 255]), [0, 9, 255, 255, 255]);
    }
}
