//! Stream messages in both sub-protocols.

use axum::extract::ws::Message;
use foreframe::server::protocol::{ClientMessage, Codec};
use foreframe_core::error_text::without_middle;
use proptest::prelude::*;
use proptest::sample::Index;

use crate::corpus::files;
use crate::mutation::{mutated, mutations};
use crate::{exclusive, within_memory};

/// Limit of memory: this many bytes per byte of a message, plus `BASE_BYTES`. In text, the name of an unknown field takes the most: two
/// bytes per byte in the reader's buffer if it has escapes, one in the path, and three while the error's text grows.
const BYTES_PER_BYTE_OF_TEXT: usize = 6;
/// In binary, a list of small numbers takes the most: each is one byte, and eight in memory.
const BYTES_PER_BYTE_OF_BINARY: usize = 9;
/// For many short lists, whose number is bounded.
const BASE_BYTES: usize = 384 << 10;

fn message(is_text: bool, bytes: Vec<u8>) -> (Codec, Message) {
    if is_text {
        (
            Codec::Json,
            Message::Text(String::from_utf8_lossy(&bytes).into_owned().into()),
        )
    } else {
        (Codec::Msgpack, Message::Binary(bytes.into()))
    }
}

/// Decodes a message, and shortens its error as the stream does, within the memory limit. An error must name the sub-protocol.
fn decode(name: &str, is_text: bool, bytes: Vec<u8>) -> Result<ClientMessage, String> {
    let per_byte = if is_text {
        BYTES_PER_BYTE_OF_TEXT
    } else {
        BYTES_PER_BYTE_OF_BINARY
    };
    let limit = BASE_BYTES + per_byte * bytes.len();
    let (codec, message) = message(is_text, bytes);
    let decoded = within_memory(limit, name, || {
        codec.decode(&message).map_err(|error| without_middle(&error))
    });
    if let Err(error) = &decoded {
        assert!(error.contains(codec.name()), "{name}: {error}");
    }
    decoded
}

#[test]
fn corpus_messages_are_accepted_or_refused_as_named() {
    let _alone = exclusive();
    for file in files("messages") {
        let decoded = decode(&file.name, file.is("json"), file.bytes.clone());
        assert_eq!(decoded.is_ok(), file.part(0) == "ok", "{}: {decoded:?}", file.name);
    }
}

proptest! {
    #[test]
    fn mutated_messages_are_decoded_or_refused(which: Index, mutations in mutations()) {
        let _alone = exclusive();
        let files = files("messages");
        let file = which.get(&files);
        let _ = decode(&file.name, file.is("json"), mutated(&file.bytes, &mutations));
    }
}

#[test]
fn decoding_memory_is_bounded_by_the_message_length() {
    let _alone = exclusive();
    let filled = |head: &[u8], item: &[u8]| [head, &item.repeat((1 << 20) / item.len())].concat();
    let named = |item: &[u8]| [filled(br#"{"type":"frame","\n"#, item), br#"":0}"#.to_vec()].concat();
    let numbers = [b"\xDC\x0F\xFF".to_vec(), vec![0; 4095]].concat();
    for (is_text, bytes) in [
        (true, filled(br#"{"type":"frame","plan":["#, b"[],")),
        (true, filled(br#"{"type":"frame","plan":[["#, b"0,")),
        (true, filled(br#"{"type":"frame","state":["#, b"0,")),
        (true, filled(br#"{"plan":["#, b"[],")),
        (true, filled(br#"{"colour":["#, b"0,")),
        (true, filled(b"{", br#""":0,"#)),
        (true, named(b"[")),
        (true, named(br"[[[[[[[\n")),
        (true, named(br"\n")),
        (true, filled(br#"{"type":""#, b"\\n")),
        (
            false,
            filled(b"\x82\xA4type\xA5frame\xA4plan\xDD\x7F\xFF\xFF\xFF", b"\x90"),
        ),
        (false, filled(b"\x82\xA4plan\xDD\x7F\xFF\xFF\xFF", b"\x90")),
        (
            false,
            filled(b"\x82\xA4type\xA5frame\xA5state\xDD\x7F\xFF\xFF\xFF", b"\x00"),
        ),
        (false, filled(b"\x82\xA6colour\xDD\x7F\xFF\xFF\xFF", b"\x00")),
        (false, filled(b"\xDF\x7F\xFF\xFF\xFF", b"\xA0\x00")),
        (
            false,
            filled(b"\x82\xA4type\xA5frame\xA4plan\xDD\x7F\xFF\xFF\xFF", &numbers),
        ),
    ] {
        let name = String::from_utf8_lossy(&bytes[..40]).into_owned();
        assert!(decode(&name, is_text, bytes).is_err(), "{name}");
    }
}
