//! Damaged JPEG images are refused in requests, on streams, by `predict` and by `import`.

use std::fs;
use std::process::Command;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::protocol::{ClientMessage, Codec, ErrorCode, FrameMessage, ServerMessage};
use foreframe::server::{ImageBytes, ImageFormat, ServerConfig};
use foreframe_core::frame::{FrameError, codec};
use foreframe_core::nn::Conditioning;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use serde_json::json;

use crate::client::{Client, numbered_frame};
use crate::service::{HEIGHT, WIDTH, app, model, post, run, spec};

const END_MARKER: [u8; 2] = [0xff, 0xd9];

/// A pattern with noise, gray or in color.
fn jpeg(width: u32, height: u32, color: ExtendedColorType) -> Vec<u8> {
    let channels = u32::from(color.channel_count());
    let intensity = |i: u32| (i / channels % width * 5 + i.wrapping_mul(2_654_435_761) / 70_000_000) as u8;
    let pixels: Vec<u8> = (0..width * height * channels).map(intensity).collect();
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 90)
        .encode(&pixels, width, height, color)
        .unwrap();
    bytes
}

fn camera_image() -> Vec<u8> {
    jpeg(WIDTH, HEIGHT, ExtendedColorType::L8)
}

/// The image without the second half of its scan.
fn cut(jpeg: &[u8]) -> &[u8] {
    let scan = jpeg.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap();
    &jpeg[..usize::midpoint(scan, jpeg.len())]
}

fn images() -> Vec<Vec<u8>> {
    let corpus = format!("{}/tests/corpus/images", env!("CARGO_MANIFEST_DIR"));
    let progressive = fs::read(format!("{corpus}/ok-progressive.jpeg")).unwrap();
    let sizes = [(WIDTH, HEIGHT), (64, 64), (33, 47)];
    let made = sizes.map(|(width, height)| {
        [ExtendedColorType::L8, ExtendedColorType::Rgb8].map(|color| jpeg(width, height, color))
    });
    made.into_iter().flatten().chain([progressive]).collect()
}

fn is_refused(bytes: &[u8]) -> bool {
    matches!(
        codec::decode(bytes),
        Err(FrameError::Damaged(_) | FrameError::Decode(_))
    )
}

#[test]
fn a_cut_jpeg_is_refused_wherever_it_is_cut() {
    for image in images() {
        codec::decode(&image).unwrap();
        for length in 0..image.len() {
            assert!(is_refused(&image[..length]), "{length} of {} bytes", image.len());
        }
    }
}

#[test]
fn a_cut_scan_with_an_end_marker_is_refused() {
    let image = jpeg(64, 64, ExtendedColorType::Rgb8);
    let scan = image.len() / 2;
    for length in (scan..image.len() - 4).step_by(7) {
        let ended = [&image[..length], &END_MARKER].concat();
        assert!(is_refused(&ended), "{length} of {} bytes", image.len());
    }
}

#[test]
fn thirty_changed_scan_bytes_are_refused() {
    let image = jpeg(64, 64, ExtendedColorType::L8);
    let start = image.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap() + 10;
    let length = image.len() - 2 - start;
    for trial in 0..200_usize {
        let mut damaged = image.clone();
        for change in 0..30 {
            let random = (trial * 30 + change + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 20;
            damaged[start + random % length] ^= 1 << (random >> 20 & 7);
        }
        assert!(is_refused(&damaged), "trial {trial}");
    }
}

#[test]
fn motion_jpeg_without_huffman_tables_is_accepted() {
    let image = jpeg(64, 64, ExtendedColorType::L8);
    let mut bytes = b"\xff\xd8\xff\xe0\0\x10AVI1\0\0\0\0\0\0\0\0\0\0".to_vec();
    let mut at = 2;
    while image[at + 1] != 0xda {
        let length = usize::from(u16::from_be_bytes([image[at + 2], image[at + 3]]));
        if ![0xc4, 0xe0].contains(&image[at + 1]) {
            bytes.extend(&image[at..at + 2 + length]);
        }
        at += 2 + length;
    }
    bytes.extend(&image[at..]);
    assert_eq!(codec::decode(&bytes).unwrap(), codec::decode(&image).unwrap());
}

#[tokio::test]
async fn a_request_with_a_damaged_jpeg_is_answered_422() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let (whole, cut) = (STANDARD.encode(camera_image()), STANDARD.encode(cut(&camera_image())));
    let unended = STANDARD.encode(&camera_image()[..camera_image().len() - 2]);
    let path = "/v1/models/plain/predict";
    let accepted = post(&app, path, &json!({"frames": [whole, whole, whole], "format": "jpeg"})).await;
    assert_eq!(accepted.status, 200);
    for damaged in [&cut, &unended] {
        for resize in [json!(null), json!("crop")] {
            let body = json!({"frames": [whole, damaged, whole], "format": "jpeg", "resize": resize});
            let detail = post(&app, path, &body).await.detail(422);
            assert!(detail.starts_with("frames[1] is a damaged JPEG image: "), "{detail}");
        }
    }
}

#[tokio::test]
async fn a_stream_refuses_a_damaged_jpeg_and_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    let mut client = Client::connect(server.address, "/v1/models/plain/stream", Codec::Msgpack)
        .await
        .unwrap();
    let image = |bytes: &[u8]| {
        ClientMessage::Frame(FrameMessage {
            image: ImageBytes(bytes.to_vec()),
            format: ImageFormat::Jpeg,
            ..numbered_frame(0)
        })
    };
    client.send(&image(cut(&camera_image()))).await;
    match client.receive().await {
        ServerMessage::Error { code, detail, next_seq } => {
            assert_eq!((code, next_seq), (ErrorCode::Invalid, 0));
            assert!(detail.starts_with("image is a damaged JPEG image: "), "{detail}");
        }
        other => panic!("{other:?}"),
    }
    client.send(&image(&camera_image())).await;
    assert!(matches!(client.receive().await, ServerMessage::Buffering { .. }));
    server.stop().await;
}

#[test]
fn predict_and_import_refuse_a_damaged_jpeg() {
    let dir = tempfile::tempdir().unwrap();
    model(&dir.path().join("models"), "plain", spec(Conditioning::None));
    let frames = dir.path().join("frames");
    fs::create_dir(&frames).unwrap();
    for index in 0..20 {
        let image = camera_image();
        let bytes = if index == 19 { cut(&image) } else { &image };
        fs::write(frames.join(format!("{index}.jpeg")), bytes).unwrap();
    }
    for (line, code) in [
        ("predict --model plain --frames frames --out out", 1),
        ("import frames --rate 5 --name walk", 2),
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_foreframe"));
        let output = command.args(line.split(' ')).current_dir(dir.path()).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{line}: {text}");
        assert!(
            text.contains("19.jpeg") && text.contains("a damaged JPEG image: "),
            "{line}: {text}"
        );
    }
}
