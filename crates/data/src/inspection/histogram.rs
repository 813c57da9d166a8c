//! Values counted in ranges.

use serde::Serialize;

/// How many values lie in each of equally wide ranges.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Histogram {
    /// Lower end of the first range.
    pub from: f64,
    /// Upper end of the last range.
    pub to: f64,
    /// Values in each range.
    pub counts: Vec<u64>,
}

impl Histogram {
    /// Counts the values in `bins` ranges from the least to the greatest value.
    pub(super) fn of(values: impl Iterator<Item = f64> + Clone, bins: usize) -> Self {
        let from = values.clone().fold(f64::INFINITY, f64::min);
        let to = values.clone().fold(f64::NEG_INFINITY, f64::max);
        let mut counts = vec![0; bins];
        for value in values {
            let place = (value - from) / (to - from).max(f64::MIN_POSITIVE) * bins as f64;
            if let Some(count) = counts.get_mut((place as usize).min(bins - 1)) {
                *count += 1;
            }
        }
        Self { from, to, counts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_counts_every_value_once() {
        let values = [0.0, 0.1, 0.5, 0.99, 1.0];
        let histogram = Histogram::of(values.iter().copied(), 4);
        assert_eq!(histogram.counts, [2, 0, 1, 2]);
        assert_eq!(Histogram::of([3.0, 3.0].into_iter(), 2).counts, [2, 0]);
    }
}
