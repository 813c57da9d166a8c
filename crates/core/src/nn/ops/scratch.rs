//! Buffers of a thread for what lies between the steps of an operation, kept for the next one. A new buffer of that size would have to
//! be filled with zeros each time.

use std::cell::Cell;

/// Buffers that an operation can have at once.
const BUFFERS: usize = 3;

thread_local! {
    static KEPT: Cell<[Vec<f32>; BUFFERS]> = const { Cell::new([const { Vec::new() }; BUFFERS]) };
}

/// Calls `run` with buffers of these lengths, whose contents are unspecified.
pub(super) fn with_buffers<R>(lengths: [usize; BUFFERS], run: impl FnOnce([&mut [f32]; BUFFERS]) -> R) -> R {
    let mut kept = KEPT.take();
    for (buffer, length) in kept.iter_mut().zip(lengths) {
        if buffer.len() < length {
            buffer.resize(length, 0.0);
        }
    }
    let [first, second, third] = &mut kept;
    let result = run([
        &mut first[..lengths[0]],
        &mut second[..lengths[1]],
        &mut third[..lengths[2]],
    ]);
    KEPT.set(kept);
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_have_the_lengths_that_were_asked_for() {
        let lengths = |asked| with_buffers(asked, |buffers| buffers.map(|buffer| buffer.len()));
        for asked in [[5, 0, 7], [1, 9, 7], [0, 0, 0]] {
            assert_eq!(lengths(asked), asked);
        }
        // One within another gets its own.
        with_buffers([2, 2, 2], |[first, ..]| {
            first.fill(1.0);
            with_buffers([2, 0, 0], |[inner, ..]| inner.fill(2.0));
            assert_eq!(first, [1.0; 2]);
        });
    }
}
