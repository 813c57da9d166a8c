//! Statistics of every column: minimum, maximum, mean and standard deviation, as LeRobot stores them with the data.

use serde::{Deserialize, Serialize};

/// Statistics of one column, with one value for each component.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ChannelStats {
    pub(crate) min: Vec<f64>,
    pub(crate) max: Vec<f64>,
    pub(crate) mean: Vec<f64>,
    pub(crate) std: Vec<f64>,
    /// Number of frames.
    pub(crate) count: u64,
}

/// Minimum, maximum, mean and variance of one component.
type ComponentStats = [f64; 4];

impl ChannelStats {
    fn new(count: u64, components: impl Iterator<Item = ComponentStats>) -> Self {
        let mut stats = Self {
            count,
            ..Self::default()
        };
        for [min, max, mean, variance] in components {
            stats.min.push(min);
            stats.max.push(max);
            stats.mean.push(mean);
            stats.std.push(variance.sqrt());
        }
        stats
    }

    /// Statistics of rows of `size` numbers, one row for each frame.
    pub(crate) fn of_rows(rows: &[f64], size: usize) -> Self {
        let count = rows.len() / size.max(1);
        let components = (0..size).map(|component| {
            let values = || rows.iter().skip(component).step_by(size);
            let mean = values().sum::<f64>() / count as f64;
            let variance = values().map(|value| (value - mean).powi(2)).sum::<f64>() / count as f64;
            [least(values().copied()), greatest(values().copied()), mean, variance]
        });
        Self::new(count as u64, components)
    }

    /// Statistics of the pixels of `frames` frames, scaled so that 255 is 1.
    pub(crate) fn of_pixels(pixels: &[u8], frames: usize) -> Self {
        let mut histogram = [0u64; 256];
        for &pixel in pixels {
            histogram[usize::from(pixel)] += 1;
        }
        let total = pixels.len() as f64;
        let levels = || (0..256).map(|level| f64::from(level) / 255.0).zip(histogram);
        let mean = levels().map(|(value, count)| value * count as f64).sum::<f64>() / total;
        let squares = levels().map(|(value, count)| (value - mean).powi(2) * count as f64);
        let variance = squares.sum::<f64>() / total;
        let present = || levels().filter(|&(_, count)| count > 0).map(|(value, _)| value);
        let component = [least(present()), greatest(present()), mean, variance];
        Self::new(frames as u64, std::iter::once(component))
    }

    /// The same for this many channels, each equal to the one that there is.
    pub(crate) fn in_channels(&self, channels: usize) -> Self {
        let components = |values: &[f64]| values.iter().copied().cycle().take(channels).collect();
        Self {
            min: components(&self.min),
            max: components(&self.max),
            mean: components(&self.mean),
            std: components(&self.std),
            count: self.count,
        }
    }

    /// Statistics of all parts together, each weighted by its number of frames.
    pub(crate) fn merged(parts: &[&Self]) -> Self {
        let size = parts.first().map_or(0, |part| part.mean.len());
        let count: u64 = parts.iter().map(|part| part.count).sum();
        let components = (0..size).map(|component| {
            let mean_of = |value: &dyn Fn(&Self) -> f64| {
                parts.iter().map(|part| part.count as f64 * value(part)).sum::<f64>() / count as f64
            };
            let mean = mean_of(&|part| part.mean[component]);
            let variance = mean_of(&|part| part.std[component].powi(2) + (part.mean[component] - mean).powi(2));
            let min = least(parts.iter().map(|part| part.min[component]));
            let max = greatest(parts.iter().map(|part| part.max[component]));
            [min, max, mean, variance]
        });
        Self::new(count, components)
    }
}

fn least(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(f64::INFINITY, f64::min)
}

fn greatest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(f64::NEG_INFINITY, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_are_computed_for_each_component() {
        let stats = ChannelStats::of_rows(&[1.0, 10.0, 3.0, 10.0], 2);
        assert_eq!(
            (stats.min, stats.max, stats.mean, stats.std, stats.count),
            (vec![1.0, 10.0], vec![3.0, 10.0], vec![2.0, 10.0], vec![1.0, 0.0], 2)
        );
    }

    #[test]
    fn merged_statistics_equal_those_of_all_frames() {
        let all: Vec<f64> = (0..30).map(|i| f64::from(i * i % 17)).collect();
        let parts = [ChannelStats::of_rows(&all[..9], 1), ChannelStats::of_rows(&all[9..], 1)];
        let merged = ChannelStats::merged(&[&parts[0], &parts[1]]);
        let whole = ChannelStats::of_rows(&all, 1);
        assert_eq!(
            (&merged.min, &merged.max, merged.count),
            (&whole.min, &whole.max, whole.count)
        );
        assert!((merged.mean[0] - whole.mean[0]).abs() < 1e-12);
        assert!((merged.std[0] - whole.std[0]).abs() < 1e-12);
    }

    #[test]
    fn half_black_half_white_has_mean_and_deviation_one_half() {
        let stats = ChannelStats::of_pixels(&[0, 255, 255, 0], 1);
        assert_eq!((stats.mean[0], stats.std[0]), (0.5, 0.5));
    }
}
