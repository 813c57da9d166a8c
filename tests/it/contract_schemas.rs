//! Every example of the contracts and of the documents, validated against the schemas by a JSON Schema validator.

use std::path::{Path, PathBuf};

use boon::{Compiler, SchemaIndex, Schemas};
use foreframe::server::openapi_document;
use serde_json::{Value, json};

/// Where the documents are for the validator; nothing is fetched from there.
const BASE: &str = "http://contract.test/";

fn project() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

fn read(path: &str) -> String {
    std::fs::read_to_string(project().join(path)).unwrap()
}

/// Both contracts, and the schemas compiled from them so far.
struct Contracts {
    openapi: Value,
    asyncapi: Value,
    schemas: Schemas,
    compiler: Compiler,
}

impl Contracts {
    fn read() -> Self {
        let openapi: Value = serde_json::from_str(&openapi_document()).unwrap();
        let asyncapi: Value = serde_yaml_ng::from_str(&read("openapi/asyncapi.yaml")).unwrap();
        let mut compiler = Compiler::new();
        for (name, document) in [("openapi.json", &openapi), ("asyncapi.yaml", &asyncapi)] {
            compiler
                .add_resource(&format!("{BASE}{name}"), document.clone())
                .unwrap();
        }
        Self {
            openapi,
            asyncapi,
            schemas: Schemas::new(),
            compiler,
        }
    }

    /// The schema at a place of a document, for example `openapi.json` and `/components/schemas/Job`.
    fn schema(&mut self, document: &str, place: &str) -> SchemaIndex {
        let location = format!("{BASE}{document}#{place}");
        self.compiler.compile(&location, &mut self.schemas).unwrap()
    }

    /// Why a value does not fit the schema there; `None` if it does.
    fn mismatch(&mut self, (document, place): (&str, &str), value: &Value) -> Option<String> {
        let schema = self.schema(document, place);
        let checked = self.schemas.validate(value, schema);
        checked.err().map(|error| format!("{document}{place}: {error:#}"))
    }

    /// Why the JSON body of a `POST` to an address does not fit the contract.
    fn body_mismatch(&mut self, address: &str, body: &Value) -> Option<String> {
        let paths = self.openapi["paths"].as_object().unwrap();
        let path = paths.keys().find(|path| is_address_of(path, address)).unwrap().clone();
        let place = format!(
            "/paths/{}/post/requestBody/content/application~1json/schema",
            escaped(&path)
        );
        self.mismatch(("openapi.json", &place), body)
    }
}

/// A key as part of a JSON pointer.
fn escaped(key: &str) -> String {
    key.replace('~', "~0")
        .replace('/', "~1")
        .replace('{', "%7B")
        .replace('}', "%7D")
}

/// Whether `/v1/models/{model}` is the path of `/v1/models/paper`.
fn is_address_of(path: &str, address: &str) -> bool {
    let (path, address): (Vec<_>, Vec<_>) = (path.split('/').collect(), address.split('/').collect());
    let mut parts = path.iter().zip(&address);
    path.len() == address.len() && parts.all(|(part, given)| part == given || part.starts_with('{'))
}

fn assert_none(mismatches: &[String]) {
    assert!(mismatches.is_empty(), "{}", mismatches.join("\n"));
}

#[test]
fn every_job_body_fits_exactly_one_variant_of_its_schema() {
    let mut contracts = Contracts::read();
    let valid = [
        json!({"kind": "collect", "name": "a", "scenario": "crowded", "trials": 2, "seed": u64::MAX}),
        json!({"kind": "import", "name": "a", "source": "mycar/data", "size": "96x64", "resize": "letterbox", "rate": 5.5,
            "every": 2, "action": ["/cmd_vel"], "unit": ["speed=m/s"], "hold": 0.5, "fov": 90.0, "tilt": -5.0,
            "camera_height": 0.2, "skip_bad": true}),
        json!({"kind": "train", "name": "a", "preset": "paper", "dataset": "d", "settings": {"sequence": {"steps": 1}},
            "after": "job-1"}),
        json!({"kind": "train", "name": "a", "from": "rooms", "from_version": 1, "dataset": "d"}),
        json!({"kind": "adapt", "name": "a", "dataset": "d", "from": "rooms", "from_version": 1, "steps": 9, "mirror": ["angle"], "remember": true}),
        json!({"kind": "evaluate", "model": "a", "dataset": "d", "version": 1, "windows": 10}),
    ];
    let mismatches: Vec<_> = valid
        .iter()
        .filter_map(|body| contracts.body_mismatch("/v1/jobs", body))
        .collect();
    assert_none(&mismatches);
    for invalid in [
        json!({"name": "a", "scenario": "crowded", "trials": 2}),
        json!({"kind": "train", "name": "a", "scenario": "crowded", "trials": 2}),
        json!({"kind": "collect", "name": "a", "scenario": "crowded", "trials": 2, "colour": "red"}),
        json!({"kind": "collect", "name": "a", "scenario": "crowded", "trials": 0}),
        json!({"kind": "import", "name": "a"}),
        json!({"kind": "train", "name": "a", "preset": "papr", "dataset": "d"}),
        json!({"kind": "adapt", "name": "a", "dataset": "d", "steps": 0}),
        json!({"kind": "import", "name": "a", "source": "b", "every": 0}),
        json!({"kind": "import", "name": "a", "source": "b", "size": "small"}),
    ] {
        assert!(contracts.body_mismatch("/v1/jobs", &invalid).is_some(), "{invalid}");
    }
    let schema = &contracts.openapi["components"]["schemas"]["JobSpec"];
    assert_eq!(schema["discriminator"]["propertyName"], "kind");
    for kind in foreframe_jobs::jobs::JobSpec::KINDS {
        let variant = schema["discriminator"]["mapping"][kind].as_str().unwrap();
        let items = schema["oneOf"].as_array().unwrap();
        assert!(items.iter().any(|item| item["$ref"] == variant), "{kind}");
        let pattern = contracts.openapi["paths"]["/v1/jobs"]["get"]["parameters"][0]["schema"]["pattern"].as_str();
        assert!(pattern.unwrap().contains(kind), "{kind}");
    }
}

#[test]
fn every_example_in_openapi_fits_its_schema() {
    let mut contracts = Contracts::read();
    let mut examples = Vec::new();
    find_examples(&contracts.openapi, String::new(), &mut examples);
    let mismatches: Vec<_> = examples
        .iter()
        .filter_map(|(place, example)| contracts.mismatch(("openapi.json", place), example))
        .collect();
    assert_none(&mismatches);
    assert!(examples.len() > 10, "{}", examples.len());
}

/// All values of `example` with the place of their schema: the object that has both, or `schema` beside it.
fn find_examples(value: &Value, place: String, found: &mut Vec<(String, Value)>) {
    match value {
        Value::Object(fields) => {
            if let Some(example) = fields.get("example") {
                let place = if fields.contains_key("schema") {
                    format!("{place}/schema")
                } else {
                    place.clone()
                };
                found.push((place, example.clone()));
            }
            for (key, field) in fields.iter().filter(|(key, _)| *key != "example") {
                find_examples(field, format!("{place}/{}", escaped(key)), found);
            }
        }
        Value::Array(items) => {
            for (index, item) in items.iter().enumerate() {
                find_examples(item, format!("{place}/{index}"), found);
            }
        }
        _ => {}
    }
}

#[test]
fn every_example_in_asyncapi_fits_its_schema() {
    let mut contracts = Contracts::read();
    let messages = contracts.asyncapi["components"]["messages"]
        .as_object()
        .unwrap()
        .clone();
    let mut mismatches = Vec::new();
    for (name, message) in &messages {
        let place = format!("/components/messages/{name}/payload");
        for example in message["examples"].as_array().unwrap() {
            mismatches.extend(contracts.mismatch(("asyncapi.yaml", &place), &example["payload"]));
        }
    }
    assert_none(&mismatches);
    assert_eq!(messages.len(), 14);
}

/// The bodies that the documents send with curl: path and JSON.
fn documented_bodies() -> Vec<(String, Value)> {
    let documents = ["README.md", "docs/http.md", "docs/training.md", "docs/operations.md"].map(read);
    let (text, mut found) = (documents.join("\n").replace("\\\n", " "), Vec::new());
    for command in text.split("\ncurl ").skip(1) {
        let address = command.split("8642").nth(1).unwrap().split_whitespace().next().unwrap();
        let Some((_, rest)) = command.split_once("-d ") else {
            continue;
        };
        let body = match rest.strip_prefix('\'') {
            Some(quoted) => quoted.split('\'').next().unwrap().to_owned(),
            None => read(rest.split_whitespace().next().unwrap().trim_start_matches('@')),
        };
        found.push((address.to_owned(), serde_json::from_str(&body).unwrap()));
    }
    found
}

#[test]
fn every_body_in_the_documents_fits_its_schema() {
    let mut contracts = Contracts::read();
    let bodies = documented_bodies();
    let mismatches: Vec<_> = bodies
        .iter()
        .filter_map(|(address, body)| contracts.body_mismatch(address, body))
        .collect();
    assert_none(&mismatches);
    assert!(bodies.len() >= 4, "{bodies:?}");
}

#[test]
fn every_accepted_body_of_the_corpus_fits_its_schema() {
    let mut contracts = Contracts::read();
    let mut accepted = 0;
    for file in std::fs::read_dir(project().join("tests/corpus/bodies")).unwrap() {
        let path = file.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        let Some(rest) = name.strip_suffix(".json").and_then(|name| name.strip_prefix('2')) else {
            continue;
        };
        let address = match rest.split('-').nth(1).unwrap() {
            "predict" => "/v1/models/plain/predict",
            "rollouts" => "/v1/models/moving/rollouts",
            "step" => "/v1/environments/a/step",
            "environments" => "/v1/environments",
            "sessions" => "/v1/sessions",
            "jobs" => "/v1/jobs",
            // Its contract is the protocol's own.
            "openenv" => continue,
            other => panic!("{other}"),
        };
        let body = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        assert_eq!(contracts.body_mismatch(address, &body), None, "{name}");
        accepted += 1;
    }
    assert!(accepted >= 8, "{accepted}");
}

#[test]
fn every_operation_and_response_is_complete() {
    let openapi: Value = serde_json::from_str(&openapi_document()).unwrap();
    let mut ids = std::collections::BTreeSet::new();
    for (path, methods) in openapi["paths"].as_object().unwrap() {
        for (method, operation) in methods.as_object().unwrap() {
            let id = operation["operationId"].as_str().unwrap();
            assert!(ids.insert(id), "{method} {path}: {id} is used twice");
            for (status, response) in operation["responses"].as_object().unwrap() {
                assert!(response["description"].is_string(), "{method} {path} {status}");
            }
        }
    }
}
