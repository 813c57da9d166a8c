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
fn every_kept_image_is_read_or_refused_as_its_name_says() {
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
fn the_size_that_an_image_states_is_refused_before_it_is_allocated() {
    let _alone = alone();
    for sample in samples("images").iter().filter(|sample| sample.name.contains("65535")) {
        // 4 GiB of pixels.
        let refused = within(3 << 20, &sample.name, || predict(&sample.name, &sample.bytes));
        assert_eq!(
            refused.detail(422),
            "frames[0] is 65535×65535 px; model \"plain\" takes 16×12; set fit to crop, letterbox or stretch to resize it"
        );
    }
}

proptest! {
    #[test]
    fn a_mutated_image_is_read_or_refused(which: Index, mutations in mutations()) {
        let _alone = alone();
        let samples = samples("images");
        let sample = which.get(&samples);
        predict(&sample.name, &mutated(&sample.bytes, &mutations));
    }
}
