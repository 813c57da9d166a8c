//! Mutations of a file's bytes.

use proptest::prelude::*;
use proptest::sample::Index;

/// Maximum size of a mutated file, so that long runs stay fast.
const MAX_BYTES: usize = 1 << 18;

#[derive(Clone, Debug)]
pub(crate) enum Mutation {
    /// Flips a bit.
    Flip(Index, u8),
    /// Removes the end.
    Cut(Index),
    /// Removes a piece.
    Drop(Index, Index),
    /// Inserts a piece many times at another position.
    Repeat(Index, Index, Index, u16),
    /// Sets four bytes to 0xFF, as in a huge length.
    Inflate(Index),
    /// Replaces a number.
    Number(Index, &'static str),
    /// Duplicates the text between two commas or braces.
    Twice(Index),
    /// Inserts deeply nested lists.
    Nest(Index, u16),
}

const NUMBERS: [&str; 9] = [
    "-1",
    "1e30",
    "3e38",
    "1e39",
    "1e308",
    "1e999",
    "18446744073709551615",
    "null",
    "0.1e-320",
];

fn mutation() -> impl Strategy<Value = Mutation> {
    let at = any::<Index>;
    prop_oneof![
        4 => (at(), 0u8..8).prop_map(|(at, bit)| Mutation::Flip(at, bit)),
        1 => at().prop_map(Mutation::Cut),
        2 => (at(), at()).prop_map(|(from, to)| Mutation::Drop(from, to)),
        2 => (at(), at(), at(), 1u16..2000).prop_map(|(from, to, into, times)| Mutation::Repeat(from, to, into, times)),
        1 => at().prop_map(Mutation::Inflate),
        4 => (at(), proptest::sample::select(&NUMBERS)).prop_map(|(at, number)| Mutation::Number(at, number)),
        2 => at().prop_map(Mutation::Twice),
        1 => (at(), 1u16..4000).prop_map(|(at, depth)| Mutation::Nest(at, depth)),
    ]
}

/// One to three mutations.
pub(crate) fn mutations() -> impl Strategy<Value = Vec<Mutation>> {
    proptest::collection::vec(mutation(), 1..4)
}

pub(crate) fn mutated(bytes: &[u8], mutations: &[Mutation]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for mutation in mutations {
        if bytes.is_empty() {
            break;
        }
        mutation.apply(&mut bytes);
        bytes.truncate(MAX_BYTES);
    }
    bytes
}

impl Mutation {
    fn apply(&self, bytes: &mut Vec<u8>) {
        let len = bytes.len();
        let ends = |a: &Index, b: &Index| {
            let (a, b) = (a.index(len), b.index(len));
            a.min(b)..a.max(b)
        };
        match self {
            Self::Flip(at, bit) => bytes[at.index(len)] ^= 1 << bit,
            Self::Cut(at) => bytes.truncate(at.index(len)),
            Self::Drop(from, to) => drop(bytes.drain(ends(from, to))),
            Self::Repeat(from, to, into, times) => {
                let piece = &bytes[ends(from, to)];
                let times = usize::from(*times).min(MAX_BYTES / piece.len().max(1));
                let again = piece.repeat(times);
                let into = into.index(len);
                bytes.splice(into..into, again);
            }
            Self::Inflate(at) => {
                let at = at.index(len);
                bytes.splice(at..(at + 4).min(len), [0xFF; 4]);
            }
            Self::Number(at, number) => {
                let is_digit = |byte: &u8| byte.is_ascii_digit();
                let from = at.index(len);
                let from = from + bytes[from..].iter().position(is_digit).unwrap_or(0);
                let to = from + bytes[from..].iter().take_while(|byte| is_digit(byte)).count();
                bytes.splice(from..to, number.bytes());
            }
            Self::Twice(at) => {
                let is_edge = |byte: &u8| b",{}[]".contains(byte);
                let at = at.index(len);
                let from = bytes[..at].iter().rposition(is_edge).map_or(0, |edge| edge + 1);
                let to = at + bytes[at..].iter().position(is_edge).unwrap_or(0);
                let twice = [&bytes[from..to], b",", &bytes[from..to]].concat();
                bytes.splice(from..to, twice);
            }
            Self::Nest(at, depth) => {
                let (at, depth) = (at.index(len), usize::from(*depth));
                let deep = [b"[".repeat(depth), b"]".repeat(depth)].concat();
                bytes.splice(at..at, deep);
            }
        }
    }
}
