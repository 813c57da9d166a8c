//! Images in prediction requests.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use proptest::prelude::*;
use proptest::sample::Index;
use serde_json::json;

use crate::corpus::files;
use crate::mutation::{mutated, mutations};
use crate::service::Answer;
use crate::test_service::SERVICE;
use crate::{exclusive, within_memory};

fn predict(name: &str, image: &[u8]) -> Answer {
    let image = STANDARD.encode(image);
    let body = json!({"frames": [image, image, image]}).to_string();
    SERVICE.json(name, "/v1/models/plain/predict", body.into())
}

#[test]
fn corpus_images_are_accepted_or_refused_as_named() {
    let _alone = exclusive();
    for file in files("images") {
        let answer = predict(&file.name, &file.bytes);
        let text = String::from_utf8_lossy(&answer.body);
        let expected = if file.part(0) == "ok" { 200 } else { 422 };
        assert_eq!(answer.status, expected, "{}: {text}", file.name);
        if expected == 422 {
            assert!(answer.detail(422).starts_with("frames[0] is "), "{}: {text}", file.name);
        }
    }
}

#[test]
fn a_huge_image_size_is_refused_before_allocation() {
    let _alone = exclusive();
    for file in files("images").iter().filter(|file| file.name.contains("65535")) {
        // 4 GiB of pixels. The test's router, with the contract, takes 5 MB.
        let refused = within_memory(16 << 20, &file.name, || predict(&file.name, &file.bytes));
        assert_eq!(
            refused.detail(422),
            "frames[0] is 65535×65535 px; model \"plain\" takes 16×12; set resize to crop, letterbox or stretch"
        );
    }
}

proptest! {
    #[test]
    fn mutated_images_are_decoded_or_refused(which: Index, mutations in mutations()) {
        let _alone = exclusive();
        let files = files("images");
        let file = which.get(&files);
        predict(&file.name, &mutated(&file.bytes, &mutations));
    }
}
