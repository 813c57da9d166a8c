//! Buffers of a thread for what lies between the steps of an operation, kept for the next one. A new buffer of that size would have to
//! be filled with zeros each time.

use std::cell::Cell;

/// Buffers that an operation can have at once.
const BUFFERS: usize = 3;
/// Values in a line of the cache. Each buffer begins with a line: a vector that lies in two of them takes longer to read and to write.
const LINE: usize = 16;

thread_local! {
    static KEPT: Cell<[Vec<f32>; BUFFERS]> = const { Cell::new([const { Vec::new() }; BUFFERS]) };
}

/// Calls `run` with buffers of these lengths, whose contents are unspecified.
pub(in crate::nn) fn with_buffers<R>(lengths: [usize; BUFFERS], run: impl FnOnce([&mut [f32]; BUFFERS]) -> R) -> R {
    let mut kept = KEPT.take();
    let mut at = 0;
    let buffers = kept.each_mut().map(|buffer| {
        let length = lengths[at];
        at += 1;
        if buffer.len() < length + LINE {
            buffer.resize(length + LINE, 0.0);
        }
        let first = buffer.as_ptr().align_offset(LINE * size_of::<f32>());
        &mut buffer[first..first + length]
    });
    let result = run(buffers);
    KEPT.set(kept);
    result
}

thread_local! {
    static KEPT_GROUPS: Cell<Vec<[u8; 4]>> = const { Cell::new(Vec::new()) };
}

/// Calls `run` with a buffer of so many groups of bytes, whose contents are unspecified.
pub(super) fn with_groups<R>(length: usize, run: impl FnOnce(&mut [[u8; 4]]) -> R) -> R {
    let mut kept = KEPT_GROUPS.take();
    if kept.len() < length {
        kept.resize(length, [0; 4]);
    }
    let result = run(&mut kept[..length]);
    KEPT_GROUPS.set(kept);
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
