//! Decompression of chunks (zstd, lz4) and of single messages (zstd), with a limit.

use std::borrow::Cow;
use std::io::Read;

/// Larger chunks and messages are refused, since one is in memory as a whole.
pub(super) const MAX_RECORD_BYTES: u64 = 128 << 20;
/// How a zstd frame begins. No CDR message does: its first byte is 0.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
/// A header that announces more than this share of a compressed piece is not believed before it is read.
const EXPECTED_RATIO: usize = 256;

/// What can be decompressed, at most `limit` bytes, and why it ended too early.
pub(super) fn decompress(name: &str, compressed: &[u8], limit: u64) -> (Vec<u8>, Option<String>) {
    let mut bytes = Vec::with_capacity((limit as usize).min(compressed.len().saturating_mul(EXPECTED_RATIO)));
    let read = match name {
        "lz4" => {
            let mut decoder = lz4_flex::frame::FrameDecoder::new(compressed).take(limit);
            decoder.read_to_end(&mut bytes).map_err(|error| error.to_string())
        }
        "zstd" => ruzstd::decoding::StreamingDecoder::new(compressed)
            .map_err(|error| error.to_string())
            .and_then(|decoder| {
                decoder
                    .take(limit)
                    .read_to_end(&mut bytes)
                    .map_err(|error| error.to_string())
            }),
        other => {
            let other: String = other.chars().take(40).collect();
            let reason = format!("has the compression {other:?}; it must be zstd, lz4 or none");
            return (bytes, Some(reason));
        }
    };
    let error = read.err().map(|error| format!("cannot be decompressed: {error}"));
    (bytes, error)
}

/// A message without the compression that rosbag2 gives single messages in its mode `message`. Errors: the reason.
pub(super) fn message(message: &[u8]) -> Result<Cow<'_, [u8]>, String> {
    if !message.starts_with(&ZSTD_MAGIC) {
        return Ok(Cow::Borrowed(message));
    }
    match decompress("zstd", message, MAX_RECORD_BYTES) {
        (bytes, None) => Ok(Cow::Owned(bytes)),
        (_, Some(error)) => Err(format!("it {error}")),
    }
}
