//! Names that nobody can guess, and secrets of which only the hash is kept.

use std::fmt::Write as _;

use sha2::{Digest as _, Sha256};

/// 256 random bits.
#[derive(Clone)]
pub(in crate::server) struct Token([u8; 32]);

/// What a server keeps of a token.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(in crate::server) struct TokenHash([u8; 32]);

impl Token {
    /// Errors: the system gives no random numbers.
    pub(super) fn random() -> Result<Self, getrandom::Error> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)?;
        Ok(Self(bytes))
    }

    pub(super) fn hash(&self) -> TokenHash {
        TokenHash::of(&self.text())
    }

    /// As a secret, hexadecimal.
    pub(in crate::server) fn text(&self) -> String {
        hex(&self.0)
    }

    /// As a name: 128 of the bits.
    pub(super) fn id(&self) -> String {
        hex(&self.0[..16])
    }

    /// As a number within this process.
    pub(super) fn key(&self) -> u64 {
        self.0.iter().take(8).fold(0, |key, &byte| key << 8 | u64::from(byte))
    }
}

impl TokenHash {
    /// Of a token's text. Hashes are compared, so that the time it takes tells nothing of the token.
    pub(super) fn of(text: &str) -> Self {
        Self(Sha256::digest(text.as_bytes()).into())
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}
