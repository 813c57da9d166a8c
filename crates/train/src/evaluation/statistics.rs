//! Means, spreads and quantiles of values, and how a calibration stores them.

/// Mean and standard deviation of values; there is at least one.
pub(super) fn mean_and_deviation(values: impl ExactSizeIterator<Item = f64> + Clone) -> [f64; 2] {
    let count = values.len() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let squares = values.map(|value| (value - mean).powi(2));
    [mean, (squares.sum::<f64>() / count).sqrt()]
}

/// The value below which this share of the values lies; between two values in proportion. There is at least one value.
pub(super) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let place = share * (values.len() - 1) as f64;
    let (below, above) = (place.floor() as usize, place.ceil() as usize);
    values[below] + (values[above] - values[below]) * place.fract()
}

/// Five digits, so that the manifest stays readable.
pub(super) fn rounded(value: f64) -> f32 {
    format!("{value:.4e}")
        .parse()
        .expect("a formatted number that cannot be read is a bug")
}
