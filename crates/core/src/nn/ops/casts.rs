//! Conversions between vectors of a processor and arrays.

/// Functions that give the same bits another type.
macro_rules! casts {
    ($($name:ident: $from:ty => $to:ty;)*) => {
        $(
            #[inline(always)]
            #[expect(unsafe_code, reason = "the standard library has no such conversion without pointers")]
            fn $name(bits: $from) -> $to {
                // SAFETY: both types have as many bits, and any bits are a value of each.
                unsafe { std::mem::transmute::<$from, $to>(bits) }
            }
        )*
    };
}

pub(super) use casts;
