//! Images, by way of a request for a prediction.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use proptest::prelude::*;
use proptest::sample::Index;
use serde_json::json;

use crate::corpus::samples;
use crate::mutation::{mutated, mutations};
use crate::service::Answer;
use crate::world::WORLD;
use crate::{alone, within};

fn predict(name: &str, image: &[u8]) -> Answer {
    let image = STANDARD.encode(image);
    let body = json!({"frames": [image, image, image]}).to_string();
    WORLD.json(name, "/v1/models/plain/predict", body.into())
}

#[test]
fn corpus_images_are_accepted_or_refused_as_named() {
    let _alone = alone();
    for sample in samples("images") {
        let answer = predict(&sample.name, &sample.bytes);
        let text = String::from_utf8_lossy(&answer.body);
        let expected = if sample.part(0) == "ok" { 200 } else { 422 };
        assert_eq!(answer.status, expected, "{}: {text}", sample.name);
        if expected == 422 {
            assert!(
                answer.detail(422).starts_with("frames[0] is "),
                "{}: {text}",
                sample.name
            );
        }
    }
}

#[test]
fn a_huge_image_size_is_refused_before_allocation() {
    let _alone = alone();
    for sample in samples("images").iter().filter(|sample| sample.name.contains("65535")) {
        // 4 GiB of pixels.
        let refused = within(3 << 20, &sample.name, || predict(&sample.name, &sample.bytes));
        assert_eq!(
            refused.detail(422),
            "frames[0] is 65535×65535 px; model \"plain\" takes 16×12"
        );
    }
}

proptest! {
    #[test]
    fn mutated_images_are_decoded_or_refused(which: Index, mutations in mutations()) {
        let _alone = alone();
        let samples = samples("images");
        let sample = which.get(&samples);
        predict(&sample.name, &mutated(&sample.bytes, &mutations));
    }
}
