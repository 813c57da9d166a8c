//! Numbers and times for people.

/// A number with about three digits that count.
pub(super) fn number(value: f64) -> String {
    let digits = match value.abs() {
        0.0 => 0,
        size if size >= 1000.0 => 0,
        size if size >= 100.0 => 1,
        size if size >= 1.0 => 2,
        size if size >= 0.01 => 3,
        _ => return format!("{value:.1e}"),
    };
    format!("{value:.digits$}")
}

/// Minutes and seconds, or hours and minutes.
pub(super) fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..60 => format!("{seconds:.1} s"),
        60..3600 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_digits_that_count() {
        let texts: Vec<String> = [0.0, 0.0512, -1.5, 123.4, 4096.2, 1e-5].map(number).into();
        assert_eq!(texts, ["0", "0.051", "-1.50", "123.4", "4096", "1.0e-5"]);
    }

    #[test]
    fn durations_are_read_at_a_glance() {
        assert_eq!(
            [9.04, 150.0, 7300.0].map(duration),
            ["9.0 s", "2 min 30 s", "2 h 1 min"]
        );
    }
}
