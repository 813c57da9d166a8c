//! Tests that need a program which not every machine has.

/// Says that a test is skipped since something is not installed. Where `CI=true`, it fails instead: `.ci/services` installs it.
pub(crate) fn skip_without(what: &str) {
    assert!(
        std::env::var("CI").as_deref() != Ok("true"),
        "{what}, and CI=true: nothing may be skipped"
    );
    println!("skipped: {what}");
}
