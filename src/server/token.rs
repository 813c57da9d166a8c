//! Random ids that nobody can guess, and secrets of which only the hash is kept.

use sha2::{Digest as _, Sha256};

use foreframe_core::files::{from_hex, hex};

/// 256 random bits.
#[derive(Clone)]
pub(in crate::server) struct Token([u8; 32]);

/// The system gave no random bytes.
#[derive(Debug, thiserror::Error)]
#[error("the system gave no random bytes: {0}")]
pub struct RandomError(#[from] getrandom::Error);

/// SHA-256 of a token's or key's text: what the server keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(in crate::server) struct TokenHash([u8; 32]);

impl Token {
    /// Errors: the system gave no random bytes.
    pub(in crate::server) fn random() -> Result<Self, RandomError> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)?;
        Ok(Self(bytes))
    }

    pub(in crate::server) fn hash(&self) -> TokenHash {
        TokenHash::of(&self.text())
    }

    /// All bits as a secret, hexadecimal.
    pub(in crate::server) fn text(&self) -> String {
        hex(&self.0)
    }

    /// 128 of the bits as an id, hexadecimal.
    pub(in crate::server) fn id(&self) -> String {
        hex(&self.0[..16])
    }

    /// 64 of the bits as a number.
    pub(in crate::server) fn key(&self) -> u64 {
        self.0.iter().take(8).fold(0, |key, &byte| key << 8 | u64::from(byte))
    }
}

impl TokenHash {
    /// Hash of a token's text. Comparing hashes takes no time that depends on the token.
    pub(in crate::server) fn of(text: &str) -> Self {
        Self(Sha256::digest(text.as_bytes()).into())
    }

    /// From hexadecimal; `None` if the text is something else.
    pub(in crate::server) fn from_hex(text: &str) -> Option<Self> {
        from_hex(text).map(Self)
    }

    pub(in crate::server) fn to_hex(self) -> String {
        hex(&self.0)
    }
}
