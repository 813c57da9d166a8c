//! Malformed messages on streams, while a healthy robot streams.

use foreframe::server::protocol::{ClientMessage, ClosingReason, Codec, ErrorCode, FrameMessage, ServerMessage};
use foreframe::server::{ImageBytes, ImageFormat, ServerConfig};
use serde_json::json;
use tokio::io::AsyncWriteExt as _;
use tokio_tungstenite::tungstenite::Message;

use futures_util::SinkExt as _;

use crate::client::{Client, numbered_frame, numbered_message};
use crate::healthy_robot::ServerWithRobot;
use crate::service::{get, poll_until};

const CODECS: [Codec; 2] = [Codec::Json, Codec::Msgpack];

fn refusal(message: &ServerMessage) -> (ErrorCode, &str, u64) {
    match message {
        ServerMessage::Error { code, detail, next_seq } => (*code, detail, *next_seq),
        other => panic!("{other:?}"),
    }
}

fn corpus_file(name: &str) -> Vec<u8> {
    std::fs::read(format!("{}/tests/corpus/{name}", env!("CARGO_MANIFEST_DIR"))).unwrap()
}

#[tokio::test]
async fn a_message_over_the_limit_closes_with_1009() {
    let mut setup = ServerWithRobot::open(ServerConfig {
        max_body_bytes: 4096,
        ..ServerConfig::default()
    })
    .await;
    let (address, session) = (setup.address(), setup.session().await);
    for (answered, codec) in CODECS.into_iter().enumerate() {
        let bad_client = async {
            let mut client = Client::connect(address, &session.path("/stream"), codec).await.unwrap();
            client.send(&numbered_message(answered as u64)).await;
            let image = ImageBytes(vec![0; 3 << 20]);
            client
                .send(&ClientMessage::Frame(FrameMessage {
                    steps: None,
                    image,
                    ..numbered_frame(9)
                }))
                .await;
            assert!(matches!(client.receive().await, ServerMessage::Buffering { .. }));
            let refused = client.receive().await;
            let (code, detail, next_seq) = refusal(&refused);
            assert_eq!((code, next_seq), (ErrorCode::Malformed, answered as u64 + 1));
            assert!(
                detail.contains("Message too long") && detail.ends_with("> 4096"),
                "{detail}"
            );
            assert_eq!(client.end().await, (Some(ClosingReason::TooLong), Some(1009)));
        };
        setup.while_robot_streams(bad_client).await;
    }
    let client = Client::connect(address, &session.path("/stream"), Codec::Json).await;
    assert_eq!(client.unwrap().next_seq, 2);
    setup.close().await;
}

#[tokio::test]
async fn websocket_protocol_errors_are_reported_before_closing() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let (address, session) = (setup.address(), setup.session().await);
    for (bytes, reason, code) in [
        // A text frame without a mask.
        (&b"\x81\x01x"[..], ClosingReason::Malformed, 1002),
        // An unknown opcode.
        (b"\x83\x80\0\0\0\0", ClosingReason::Malformed, 1002),
        // A continuation frame without a first frame.
        (b"\x80\x80\0\0\0\0", ClosingReason::Malformed, 1002),
        // A reserved bit, as set by compression, which was not negotiated.
        (b"\xC1\x80\0\0\0\0", ClosingReason::Malformed, 1002),
        (b"\x81\x82\0\0\0\0\xFF\xFE", ClosingReason::NotUtf8, 1007),
    ] {
        let bad_client = async {
            let mut client = Client::connect(address, &session.path("/stream"), Codec::Json)
                .await
                .unwrap();
            client.socket.get_mut().write_all(bytes).await.unwrap();
            assert_eq!(refusal(&client.receive().await).0, ErrorCode::Malformed);
            assert_eq!(client.end().await, (Some(reason), Some(code)), "{bytes:?}");
        };
        setup.while_robot_streams(bad_client).await;
    }
    setup.close().await;
}

#[tokio::test]
async fn a_message_of_the_wrong_type_is_refused() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let (address, session) = (setup.address(), setup.session().await);
    for (codec, message, kind) in [
        (Codec::Msgpack, Message::text(r#"{"type":"ping"}"#), "binary"),
        (Codec::Json, Message::binary(vec![0x80]), "text"),
    ] {
        let bad_client = async {
            let mut client = Client::connect(address, &session.path("/stream"), codec).await.unwrap();
            let seq = client.next_seq;
            client.socket.send(message).await.unwrap();
            let answer = client.receive().await;
            let detail = format!("{} takes {kind} messages", codec.name());
            assert_eq!(refusal(&answer), (ErrorCode::Malformed, detail.as_str(), seq));
            assert!(matches!(
                client.ask(&numbered_message(seq)).await,
                ServerMessage::Buffering { .. }
            ));
        };
        setup.while_robot_streams(bad_client).await;
    }
    setup.close().await;
}

#[tokio::test]
async fn an_invalid_frame_is_refused_with_the_field() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let (address, session) = (setup.address(), setup.session().await);
    let frame = |change: &dyn Fn(&mut FrameMessage)| {
        let mut message = numbered_frame(0);
        change(&mut message);
        ClientMessage::Frame(message)
    };
    let image = |name: &'static str| {
        move |message: &mut FrameMessage| {
            message.image = ImageBytes(corpus_file(&format!("images/{name}")));
            message.format = ImageFormat::Png;
        }
    };
    let bad: [(ClientMessage, &str); 8] = [
        (
            frame(&|m| m.action = Some(vec![0.0, f32::NAN])),
            "action: action component 1 is NaN",
        ),
        (
            frame(&|m| m.plan = Some(vec![vec![f32::INFINITY; 2]; 2])),
            "plan: action component 0 is inf",
        ),
        (frame(&|m| m.state = Some(vec![3e38])), "state: state component 0 is 3"),
        (frame(&|m| m.action = Some(vec![0.0; 3])), "action holds 3 numbers"),
        (
            frame(&|m| m.image = ImageBytes(vec![0; 191])),
            "image holds 191 raw bytes",
        ),
        (frame(&image("refused-says-65535.png")), "image is 65535×65535 px"),
        (frame(&image("refused-says-65535.jpeg")), "image is 65535×65535 px"),
        (
            frame(&image("refused-fewer-rows-than-said.png")),
            "image is not a readable",
        ),
    ];
    let bad_client = async {
        let mut client = Client::connect(address, &session.path("/stream"), Codec::Msgpack)
            .await
            .unwrap();
        for (message, expected) in &bad {
            let answer = client.ask(message).await;
            let (code, detail, next_seq) = refusal(&answer);
            assert_eq!((code, next_seq), (ErrorCode::Invalid, 0));
            assert!(detail.starts_with(expected), "{detail}");
        }
        for name in [
            "refused-list-of-4-billion.msgpack",
            "refused-deep.msgpack",
            "refused-half.msgpack",
        ] {
            let bytes = corpus_file(&format!("messages/{name}"));
            client.socket.send(Message::binary(bytes)).await.unwrap();
            assert_eq!(refusal(&client.receive().await).0, ErrorCode::Malformed, "{name}");
        }
        assert!(matches!(
            client.ask(&numbered_message(0)).await,
            ServerMessage::Buffering { .. }
        ));
    };
    setup.while_robot_streams(bad_client).await;
    setup.close().await;
}

#[tokio::test]
async fn refusals_quote_only_a_short_part_of_a_message() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let (address, session) = (setup.address(), setup.session().await);
    let bad_client = async {
        let mut client = Client::connect(address, &session.path("/stream"), Codec::Json)
            .await
            .unwrap();
        let key = "colour".repeat(100_000);
        client.send_text(&json!({"type": "ping", key: 1}).to_string()).await;
        let answer = client.receive().await;
        let (_, detail, _) = refusal(&answer);
        assert!(
            detail.len() < 1100 && detail.contains("expected one of `type`"),
            "{detail}"
        );
    };
    setup.while_robot_streams(bad_client).await;
    setup.close().await;
}

#[tokio::test]
async fn a_partial_message_does_not_change_the_session() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let (address, session) = (setup.address(), setup.session().await);
    // Part of a binary message of 16 KiB; half a header; the first of several fragments.
    for part in [
        &b"\x82\xFE\x40\0\0\0\0\0half a mess"[..],
        b"\x82",
        b"\x02\x83\0\0\0\0abc",
    ] {
        let bad_client = async {
            let mut client = Client::connect(address, &session.path("/stream"), Codec::Msgpack)
                .await
                .unwrap();
            let seq = client.next_seq;
            client.ask(&numbered_message(seq)).await;
            client.socket.get_mut().write_all(part).await.unwrap();
            client.socket.get_mut().shutdown().await.unwrap();
            drop(client);
            seq + 1
        };
        let next_seq = setup.while_robot_streams(bad_client).await;
        let path = format!("/v1/sessions/{}", session.id);
        poll_until(async || {
            let described = get(&setup.app, &path).await.json();
            (described["connected"] == false).then(|| assert_eq!(described["next_seq"], next_seq))
        })
        .await;
    }
    setup.close().await;
}
