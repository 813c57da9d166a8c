//! Stream clients that read slowly or never, and their effect on others.

use std::time::{Duration, Instant};

use foreframe::server::protocol::{ClientMessage, ClosingReason, Codec, FrameMessage, ServerMessage, WarningCode};
use foreframe::server::{ImageBytes, ImageFormat, ServerConfig};
use foreframe_core::nn::{Conditioning, ModelSpec};

use crate::client::Client;
use crate::service::{self, InProcessServer, model, run, spec, with_data};

const SIDE: u32 = 256;
/// Long, so that a busy machine delays neither side for as long as half of it.
const SEND_TIMEOUT: Duration = Duration::from_secs(4);
/// A client beside a slow one is answered faster, also on a busy machine.
const SLOWEST: Duration = Duration::from_secs(15);

/// A server with a model whose answers are so large (half a megabyte) that they soon fill a socket.
async fn start(dir: &std::path::Path) -> InProcessServer {
    let config = ServerConfig {
        stream_send_ms: SEND_TIMEOUT.as_millis() as u64,
        max_stream_buffer_bytes: 1 << 20,
        ..with_data(dir, ServerConfig::default())
    };
    let large = ModelSpec {
        frame_width_px: SIDE,
        frame_height_px: SIDE,
        context: 1,
        horizon: 8,
        ..spec(Conditioning::None)
    };
    run(service::start(config, vec![model(dir, "large", large)])).await
}

async fn connect(server: &InProcessServer) -> Client {
    Client::connect(server.address, "/v1/models/large/stream", Codec::Msgpack)
        .await
        .unwrap()
}

fn frame(seq: u64) -> ClientMessage {
    ClientMessage::Frame(FrameMessage {
        steps: None,
        seq,
        timestamp_us: 0,
        image: ImageBytes(vec![seq as u8; (SIDE * SIDE) as usize]),
        format: ImageFormat::Raw,
        action: None,
        state: None,
        plan: None,
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_never_reads_is_closed_with_1013() {
    let dir = tempfile::tempdir().unwrap();
    let server = start(dir.path()).await;
    let mut client = connect(&server).await;
    client.ask(&frame(0)).await;
    // The server sends the cached answer for each. Its time limit starts when the socket is full, at the latest half of the
    // limit from now. When the limit has passed, the server tries for as long again to say why it closes: reading starts
    // in the middle of that time.
    let flood = async { while client.try_send(&frame(0)).await.is_ok() {} };
    let _ = tokio::time::timeout(SEND_TIMEOUT + SEND_TIMEOUT / 2, flood).await;
    assert_eq!(client.end().await, (Some(ClosingReason::Slow), Some(1013)));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_slow_client_is_told_how_many_predictions_were_dropped() {
    let dir = tempfile::tempdir().unwrap();
    let server = start(dir.path()).await;
    let mut client = connect(&server).await;
    client.ask(&frame(0)).await;
    let sent = 100;
    for _ in 0..sent {
        client.send(&frame(0)).await;
    }
    let (mut dropped_total, mut read, mut is_warned) = (0, 0, false);
    while dropped_total + read < sent {
        match client.receive().await {
            ServerMessage::Prediction { dropped, .. } => {
                dropped_total += dropped;
                read += 1;
            }
            ServerMessage::Warning { code, .. } => {
                assert_eq!(code, WarningCode::Slow);
                is_warned = true;
            }
            other => panic!("{other:?}"),
        }
    }
    assert!(dropped_total > 0 && is_warned, "{dropped_total} dropped of {sent}");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_slow_client_does_not_delay_others() {
    let dir = tempfile::tempdir().unwrap();
    let server = start(dir.path()).await;
    let mut slow = connect(&server).await;
    let flood = tokio::spawn(async move { while slow.try_send(&frame(0)).await.is_ok() {} });
    let others = (0..20).map(|_| async {
        let mut client = connect(&server).await;
        let mut slowest = Duration::ZERO;
        for seq in 0..10 {
            let asked = Instant::now();
            assert!(matches!(
                client.ask(&frame(seq)).await,
                ServerMessage::Prediction { .. }
            ));
            slowest = slowest.max(asked.elapsed());
        }
        slowest
    });
    for slowest in futures_util::future::join_all(others).await {
        assert!(slowest < SLOWEST, "{slowest:?}");
    }
    flood.abort();
    server.stop().await;
}
