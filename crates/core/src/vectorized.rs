//! Loops with the widest vector instructions that the machine has, chosen at run time.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use pulp::{Arch, Simd, WithSimd};

/// Runs a loop, with all that is inlined into it, with the widest vector instructions of this machine. Pass the closure as a
/// literal with `#[inline(always)]`; each function that it calls in the loop must be `#[inline(always)]` too.
///
/// The compiler takes a closure's kind from the bound of the function that it is passed to. `Arch::dispatch` asks for
/// `WithSimd`, so a closure that could run twice becomes `Fn` or `FnMut` and is called through a wrapper, which may be left
/// without the vector instructions. With the bound `FnOnce` there is no wrapper.
pub fn vectorized<R>(run: impl FnOnce() -> R) -> R {
    Arch::new().dispatch(Loop(run))
}

struct Loop<F>(F);

impl<R, F: FnOnce() -> R> WithSimd for Loop<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> R {
        (self.0)()
    }
}
