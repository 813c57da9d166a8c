//! The frames of a session: order, gaps, repeated, pipelined and overtaken frames, and lost connections.

use foreframe::server::protocol::{
    ClientMessage, CloseMessage, ClosingReason, Codec, ConfigureMessage, ErrorCode, OnGap, OnLate, ServerMessage,
    SessionSettings,
};
use foreframe::server::{ImageFormat, ServerConfig};
use proptest::prelude::*;
use serde_json::json;

use crate::client::{Client, SessionHandle, numbered_frame, numbered_message};
use crate::service::{app, get, post, run};
use crate::sessions::{code, frames, moving};

#[tokio::test]
async fn on_gap_skip_accepts_a_gap_and_reports_it() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    assert_eq!(code(&client.ask(&numbered_message(2)).await), (ErrorCode::Gap, 0));
    let configure = ClientMessage::Configure(ConfigureMessage {
        on_gap: Some(OnGap::Skip),
        on_late: None,
        format: Some(ImageFormat::Png),
        resize: None,
        ..ConfigureMessage::default()
    });
    let configured = ServerMessage::Configured(SessionSettings {
        on_gap: OnGap::Skip,
        on_late: OnLate::Predict,
        format: Some(ImageFormat::Png),
        resize: None,
    });
    assert_eq!(client.ask(&configure).await, configured);
    for (seq, expected) in [(2, 2), (3, 0), (5, 1)] {
        let answer = client.ask(&numbered_message(seq)).await;
        let (ServerMessage::Buffering { skipped, .. } | ServerMessage::Prediction { skipped, .. }) = answer else {
            panic!("{answer:?}")
        };
        assert_eq!(skipped, expected);
    }
    let ServerMessage::Prediction { format, frames, .. } = client.ask(&numbered_message(6)).await else {
        panic!()
    };
    assert_eq!(format, ImageFormat::Png);
    assert!(frames[0].0.starts_with(b"\x89PNG"));
    assert_eq!(
        code(&client.ask(&numbered_message(u64::MAX)).await),
        (ErrorCode::Invalid, 7)
    );
    let settings = get(&app, &session.path("/state")).await.json();
    assert_eq!(
        (&settings["on_gap"], &settings["format"]),
        (&json!("skip"), &json!("png"))
    );
    server.stop().await;
}

#[tokio::test]
async fn on_late_skip_predicts_only_from_the_newest_frame() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let (skipping, predicting) = (
        SessionHandle::open(&app, &moving()).await,
        SessionHandle::open(&app, &moving()).await,
    );
    let connect = async |session: &SessionHandle| {
        let client = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack).await;
        client.unwrap()
    };
    let (mut skipped, mut predicted) = (connect(&skipping).await, connect(&predicting).await);
    let configure = ClientMessage::Configure(ConfigureMessage {
        on_late: Some(OnLate::Skip),
        ..ConfigureMessage::default()
    });
    let configured = ServerMessage::Configured(SessionSettings {
        on_late: OnLate::Skip,
        ..SessionSettings::default()
    });
    assert_eq!(skipped.ask(&configure).await, configured);
    let count = 200;
    for seq in 0..count {
        skipped.send(&numbered_message(seq)).await;
    }
    // A repeated frame overtakes nothing.
    skipped.send(&numbered_message(count - 1)).await;
    let (mut overtaken, mut in_a_row) = (0, 0);
    for expected in 0..count {
        let from_all = predicted.ask(&numbered_message(expected)).await;
        let answer = skipped.receive().await;
        match &answer {
            ServerMessage::Overtaken { seq, timestamp_us, .. } => {
                assert_eq!((*seq, *timestamp_us), (expected, numbered_frame(expected).timestamp_us));
                overtaken += 1;
                in_a_row += 1;
                assert!(in_a_row <= ServerConfig::default().max_pipelined_frames);
            }
            ServerMessage::Buffering { seq, .. } => assert_eq!(*seq, expected),
            _ => {
                // Overtaken frames are part of the context too.
                assert_eq!(frames(&answer), frames(&from_all));
                in_a_row = 0;
            }
        }
        if expected + 1 == count {
            assert_eq!(frames(&skipped.receive().await), frames(&answer));
        }
    }
    assert!(overtaken > 0);
    let settings = get(&app, &skipping.path("/state")).await.json();
    assert_eq!(settings["on_late"], json!("skip"));
    server.stop().await;
}

#[tokio::test]
async fn pipelined_frames_are_answered_in_order() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    for seq in 0..100 {
        client.send(&numbered_message(seq)).await;
    }
    client.send(&ClientMessage::Close(CloseMessage {})).await;
    for expected in 0..100 {
        let answer = client.receive().await;
        let (ServerMessage::Buffering { seq, .. } | ServerMessage::Prediction { seq, .. }) = answer else {
            panic!("{answer:?}")
        };
        assert_eq!(seq, expected);
    }
    assert_eq!(client.end().await, (Some(ClosingReason::Asked), Some(1000)));
    server.stop().await;
}

#[derive(Clone, Copy, Debug)]
enum NetworkFault {
    /// No fault: the next frame.
    Next,
    /// One of the last frames is repeated.
    Twice(u64),
    /// Frames are skipped.
    Ahead(u64),
    /// Two frames in the wrong order.
    Swapped,
    /// The connection is lost.
    Lost,
    /// The connection is lost after a frame was sent and before its answer arrives.
    LostAfter,
}

fn fault() -> impl Strategy<Value = NetworkFault> {
    prop_oneof![
        4 => Just(NetworkFault::Next),
        2 => (0u64..4).prop_map(NetworkFault::Twice),
        1 => (1u64..4).prop_map(NetworkFault::Ahead),
        1 => Just(NetworkFault::Swapped),
        1 => Just(NetworkFault::Lost),
        1 => Just(NetworkFault::LostAfter),
    ]
}

async fn run_with_faults(faults: &[NetworkFault]) -> Result<(), TestCaseError> {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let path = session.path("/stream");
    let connect = async || Client::connect(server.address, &path, Codec::Msgpack).await.unwrap();
    let mut client = connect().await;
    let mut next = 0;
    for fault in faults {
        match *fault {
            NetworkFault::Next => {
                client.ask(&numbered_message(next)).await;
                next += 1;
            }
            NetworkFault::Twice(back) if next > 0 => {
                client.ask(&numbered_message((next - 1).saturating_sub(back))).await;
            }
            NetworkFault::Twice(_) => {}
            NetworkFault::Ahead(by) => {
                prop_assert_eq!(
                    code(&client.ask(&numbered_message(next + by)).await),
                    (ErrorCode::Gap, next)
                );
            }
            NetworkFault::Swapped => {
                client.ask(&numbered_message(next + 1)).await;
                client.ask(&numbered_message(next)).await;
                next += 1;
            }
            NetworkFault::Lost => client = connect().await,
            NetworkFault::LostAfter => {
                client.send(&numbered_message(next)).await;
                client = connect().await;
                // The server says whether it accepted the frame.
                prop_assert!(client.next_seq == next || client.next_seq == next + 1);
                next = client.next_seq;
            }
        }
        let described = get(&app, &format!("/v1/sessions/{}", session.id)).await.json();
        prop_assert_eq!(&described["next_seq"], next);
    }
    let reference = SessionHandle::open(&app, &moving()).await;
    let mut client = Client::connect(server.address, &reference.path("/stream"), Codec::Json)
        .await
        .unwrap();
    for seq in 0..next {
        client.ask(&numbered_message(seq)).await;
    }
    let (found, expected) = (
        get(&app, &session.path("/state")).await,
        get(&app, &reference.path("/state")).await,
    );
    prop_assert_eq!(found.json(), expected.json());
    drop(client);
    server.stop().await;
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn network_faults_do_not_change_the_session_state(
        faults in proptest::collection::vec(fault(), 1..24),
    ) {
        tokio::runtime::Runtime::new().unwrap().block_on(run_with_faults(&faults))?;
    }

    #[test]
    fn random_session_bodies_never_cause_a_server_error(
        pointer in prop_oneof![
            Just(""), Just("/state"), Just("/state/snapshot"), Just("/state/snapshot/features"), Just("/state/snapshot/features/0"),
            Just("/state/snapshot/next_seq"), Just("/state/snapshot/actions"), Just("/state/version"), Just("/model"),
        ],
        garbage in prop_oneof![
            Just(json!(null)), Just(json!([])), Just(json!({})), Just(json!("")), any::<i64>().prop_map(|n| json!(n)),
            any::<f32>().prop_map(|x| json!([x, [x]])), Just(json!([[[[[[]]]]]])), Just(json!([["a"]])),
        ],
    ) {
        tokio::runtime::Runtime::new().unwrap().block_on(async {
            let dir = tempfile::tempdir().unwrap();
            let app = app(dir.path(), ServerConfig::default());
            let session = SessionHandle::open(&app, &moving()).await;
            let mut body = json!({"model": "moving", "state": get(&app, &session.path("/state")).await.json()});
            body["state"]["snapshot"]["features"] = json!([vec![0.0; 8]]);
            if let Some(place) = body.pointer_mut(pointer) {
                *place = garbage;
            }
            let status = post(&app, "/v1/sessions", &body).await.status.as_u16();
            prop_assert!([201, 400, 404, 409, 422].contains(&status), "{status} {body}");
            Ok(())
        })?;
    }
}

#[tokio::test]
async fn a_truncated_frame_is_ignored() {
    use tokio::io::AsyncWriteExt as _;
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    client.ask(&numbered_message(0)).await;
    // The header of a masked binary message of 200 bytes, and its first three bytes.
    client
        .socket
        .get_mut()
        .write_all(&[0x82, 0xFE, 0, 200, 1, 2, 3, 4, 5, 6, 7])
        .await
        .unwrap();
    drop(client);
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    assert_eq!(client.next_seq, 1);
    assert!(matches!(
        client.ask(&numbered_message(1)).await,
        ServerMessage::Buffering { have: 2, .. }
    ));
    server.stop().await;
}

#[tokio::test]
async fn an_invalid_frame_does_not_change_the_session() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    let before = get(&app, &session.path("/state")).await.json();
    // A PNG whose header states 60,000 × 60,000 pixels.
    let mut oversized_png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\xea\x60\0\0\xea\x60\x08\0\0\0\0\0\0\0\0".to_vec();
    oversized_png.extend([0; 64]);
    let changed = |change: &dyn Fn(&mut foreframe::server::protocol::FrameMessage)| {
        let mut message = numbered_frame(0);
        change(&mut message);
        ClientMessage::Frame(message)
    };
    for (message, detail) in [
        (
            changed(&|m| m.action = Some(vec![f32::NAN, 0.0])),
            "action component 0 is NaN",
        ),
        (
            changed(&|m| m.state = Some(vec![f32::INFINITY])),
            "state component 0 is inf",
        ),
        (
            changed(&|m| m.plan = Some(vec![vec![0.0; 2]; 3])),
            "plan holds 3 actions",
        ),
        (
            changed(&|m| m.plan = Some(vec![vec![0.0; 3]; 2])),
            "plan[0] holds 3 numbers",
        ),
        (changed(&|m| m.action = None), "action is missing"),
        (changed(&|m| m.image.0.truncate(5)), "image holds 5 raw bytes"),
        (
            changed(&|m| {
                m.image.0.clone_from(&oversized_png);
                m.format = ImageFormat::Png;
            }),
            "image is",
        ),
    ] {
        let answer = client.ask(&message).await;
        let ServerMessage::Error {
            code,
            detail: found,
            next_seq,
        } = answer
        else {
            panic!("{answer:?}")
        };
        assert_eq!((code, next_seq), (ErrorCode::Invalid, 0), "{found}");
        assert!(found.contains(detail), "{found}");
    }
    client.send_text("{}").await;
    assert_eq!(code(&client.receive().await), (ErrorCode::Malformed, 0));
    assert_eq!(get(&app, &session.path("/state")).await.json(), before);
    assert!(matches!(
        client.ask(&numbered_message(0)).await,
        ServerMessage::Buffering { have: 1, .. }
    ));
    server.stop().await;
}
