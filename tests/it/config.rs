//! The configuration: precedence, sources of values, and refusals.

use foreframe::config::{Config, LoadedConfig, environment_layers};
use foreframe::telemetry::LogFormat;
use foreframe_train::settings::{SettingsError, SettingsLayer};

fn environment(variables: &[(&str, &str)]) -> Vec<SettingsLayer> {
    let owned = variables
        .iter()
        .map(|(name, text)| ((*name).to_owned(), (*text).to_owned()));
    environment_layers(owned).collect()
}

fn file(text: &str) -> SettingsLayer {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("mine.toml");
    std::fs::write(&path, text).unwrap();
    SettingsLayer::file(&path).unwrap()
}

fn refused(layers: Vec<SettingsLayer>) -> String {
    LoadedConfig::from_layers(layers).unwrap_err().to_string()
}

#[test]
fn flags_override_environment_file_and_defaults() {
    let layers = [file("max_streams = 1\nmax_frames = 1\nmax_batch = 1")]
        .into_iter()
        .chain(environment(&[
            ("FOREFRAME_MAX_STREAMS", "2"),
            ("FOREFRAME_MAX_FRAMES", "2"),
        ]))
        .chain([SettingsLayer::assignment("max_streams=3").unwrap()]);
    let loaded = LoadedConfig::from_layers(layers).unwrap();
    let limits = &loaded.config.server;
    assert_eq!((limits.max_streams, limits.max_frames, limits.max_batch), (3, 2, 1));
    let text = loaded.to_toml();
    for line in [
        "max_streams = 3  # --set; 1 to 1000000",
        "max_frames = 2  # environment FOREFRAME_MAX_FRAMES; 1 to 4096",
        "bind = \"127.0.0.1:8642\"  # default",
        "# database_url is not set",
    ] {
        assert!(text.lines().any(|found| found == line), "{line} is not in\n{text}");
    }
    assert!(text.contains("mine.toml; 1 to 512"), "{text}");
}

#[test]
fn the_printed_configuration_is_a_valid_file() {
    let settings = [
        "drain_ms=5",
        "cors_origins=[\"http://a\"]",
        "log_format=json",
        "models_dir=m",
    ];
    let settings = settings.map(|setting| SettingsLayer::assignment(setting).unwrap());
    let printed = LoadedConfig::from_layers(settings).unwrap();
    let read = LoadedConfig::from_layers([file(&printed.to_toml())]).unwrap();
    assert_eq!(read.config, printed.config);
    assert_eq!(read.config.log_format, LogFormat::Json);
    assert_eq!(read.config.server.job_log_format, LogFormat::Json);
    assert_eq!(read.config.server.cors_origins, ["http://a"]);
}

#[test]
fn an_origin_that_no_page_has_is_refused() {
    for wrong in [
        "robots.example",
        "https://robots.example/page",
        "https://user@robots.example",
        "*",
    ] {
        let message = refused(environment(&[("FOREFRAME_CORS_ORIGINS", &format!("[\"{wrong}\"]"))]));
        let expected = format!("cors_origins holds \"{wrong}\" (environment FOREFRAME_CORS_ORIGINS); an origin is");
        assert!(message.starts_with(&expected), "{message}");
    }
}

#[test]
fn every_limit_is_checked_against_its_range() {
    let defaults = Config::default().server;
    for (field, value, range) in defaults.bounds() {
        let setting = SettingsLayer::assignment(&format!("{field}={value}")).unwrap();
        assert_eq!(
            LoadedConfig::from_layers([setting]).unwrap().config.server,
            defaults,
            "{field}"
        );
        let too_much = range.end() + 1;
        let message = refused(environment(&[(
            &format!("FOREFRAME_{}", field.to_uppercase()),
            &too_much.to_string(),
        )]));
        let (least, most) = (range.start(), range.end());
        assert!(
            message.starts_with(&format!("{field} is {too_much} (environment FOREFRAME_")),
            "{message}"
        );
        assert!(message.ends_with(&format!("it must be {least} to {most}")), "{message}");
    }
}

#[test]
fn invalid_settings_are_refused_with_their_source() {
    let set = |setting| vec![SettingsLayer::assignment(setting).unwrap()];
    for (layers, expected) in [
        (
            environment(&[("FOREFRAME_MAX_STREAM", "2")]),
            "unknown field `max_stream` (environment FOREFRAME_MAX_STREAM); `foreframe config` lists all settings",
        ),
        (
            set("max_streams=many"),
            "max_streams is \"many\" (--set); it must be a whole number, 1 to 1000000",
        ),
        (
            set("max_streams=-1"),
            "max_streams is -1 (--set); it must be a whole number, 1 to 1000000",
        ),
        (
            set("max_streams=5.0"),
            "max_streams is 5.0 (--set); it must be a whole number, 1 to 1000000",
        ),
        (
            set("drain_ms=5s"),
            "drain_ms is \"5s\" (--set); it must be a whole number of milliseconds, 0 to 10000",
        ),
        (
            set("max_body_bytes=1MiB"),
            "max_body_bytes is \"1MiB\" (--set); it must be a whole number of bytes, 1024 to 1073741824",
        ),
        (
            set("bind=localhost:http"),
            "bind is \"localhost:http\" (--set); it must be HOST:PORT, as in 127.0.0.1:8642 or localhost:8642",
        ),
        (set("port=70000"), "port is 70000 (--set); it must be 0 to 65535"),
        (
            set("log_format=xml"),
            "log_format is \"xml\" (--set); it must be text or json",
        ),
        (set("insecure=2"), "insecure is 2 (--set); it must be true or false"),
    ] {
        assert_eq!(refused(layers), expected);
    }
    assert!(matches!(
        SettingsLayer::assignment("max_streams"),
        Err(SettingsError::Assignment(_))
    ));
    let dir = tempfile::tempdir().unwrap();
    assert!(matches!(
        SettingsLayer::file(&dir.path().join("none")),
        Err(SettingsError::Read { .. })
    ));
    std::fs::write(dir.path().join("bad"), "a = = 1").unwrap();
    assert!(matches!(
        SettingsLayer::file(&dir.path().join("bad")),
        Err(SettingsError::Toml { .. })
    ));
}

#[test]
fn variables_of_a_kubernetes_service_are_refused_with_the_remedy() {
    for (name, value) in [
        ("FOREFRAME_SERVICE_HOST", "10.0.0.1"),
        ("FOREFRAME_SERVICE_PORT", "80"),
        ("FOREFRAME_PORT", "tcp://10.0.0.1:80"),
        ("FOREFRAME_PORT_80_TCP", "tcp://10.0.0.1:80"),
        ("FOREFRAME_PORT_80_TCP_PROTO", "tcp"),
        ("FOREFRAME_SERVER_SERVICE_HOST", "10.0.0.1"),
    ] {
        let message = refused(environment(&[(name, value)]));
        assert!(
            message.contains("set enableServiceLinks: false in the pod"),
            "{message}"
        );
    }
    for (name, value) in [("FOREFRAME_PORT", "80x"), ("FOREFRAME_IMPORT_DIRS", "a")] {
        let message = refused(environment(&[(name, value)]));
        assert!(!message.contains("enableServiceLinks"), "{message}");
    }
}

#[test]
fn a_port_replaces_that_of_the_address_and_names_are_resolved() {
    let bind = |settings: &[&str]| {
        let layers = settings
            .iter()
            .map(|setting| SettingsLayer::assignment(setting).unwrap());
        LoadedConfig::from_layers(layers).unwrap().config.bind.to_string()
    };
    assert_eq!(bind(&["bind=localhost:9000"]), "127.0.0.1:9000");
    assert_eq!(bind(&["bind=localhost:9000", "port=9001"]), "127.0.0.1:9001");
    assert_eq!(bind(&["port=9001"]), "127.0.0.1:9001");
}

#[test]
fn empty_urls_and_test_variables_are_ignored() {
    let variables = [
        ("FOREFRAME_DATABASE_URL", ""),
        ("FOREFRAME_TEST_POSTGRES", "x"),
        ("HOME", "/"),
    ];
    let loaded = LoadedConfig::from_layers(environment(&variables)).unwrap();
    assert_eq!(loaded.config, Config::default());
}

#[test]
fn a_password_is_not_printed() {
    let url = "database_url=postgres://ada:secret@db/foreframe";
    let text = LoadedConfig::from_layers([SettingsLayer::assignment(url).unwrap()])
        .unwrap()
        .to_toml();
    assert!(
        text.contains("postgres://ada:***@db/foreframe") && !text.contains("secret"),
        "{text}"
    );
}

#[test]
fn a_device_is_named_and_one_that_cannot_be_used_is_refused_with_its_source() {
    let set = |text: &str| vec![SettingsLayer::assignment(text).unwrap()];
    let error = refused(set("device=gpu"));
    assert!(
        error.contains("device is \"gpu\" (--set)") && error.contains("cuda:N"),
        "{error}"
    );
    LoadedConfig::from_layers(set("device=cpu"))
        .unwrap()
        .choose_computation()
        .unwrap();
    // Built without CUDA; with it, this process has chosen the CPU above.
    let loaded = LoadedConfig::from_layers(set("device=cuda:99")).unwrap();
    let error = loaded.choose_computation().unwrap_err().to_string();
    assert!(error.starts_with("device is \"cuda:99\" (--set): "), "{error}");
    if !cfg!(feature = "cuda") {
        assert!(error.contains("cargo build --release --features cuda"), "{error}");
    }
}

#[test]
fn a_precision_is_named_and_another_one_than_the_first_is_refused_with_its_source() {
    let set = |text: &str| vec![SettingsLayer::assignment(text).unwrap()];
    let error = refused(set("precision=f16"));
    assert!(
        error.contains("precision is \"f16\" (--set)") && error.contains("f32, bf16 or int8"),
        "{error}"
    );
    LoadedConfig::from_layers(set("precision=f32"))
        .unwrap()
        .choose_computation()
        .unwrap();
    // Another one was chosen above, or this processor cannot.
    let loaded = LoadedConfig::from_layers(set("precision=int8")).unwrap();
    let error = loaded.choose_computation().unwrap_err().to_string();
    assert!(
        error.starts_with("precision is \"int8\" (--set): this process"),
        "{error}"
    );
}
