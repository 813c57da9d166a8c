//! The stream's contract, `openapi/asyncapi.yaml`, checked against the codec.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Debug;
use std::fs;

use axum::extract::ws::Message;
use foreframe::server::protocol::{ClientMessage, Codec, ServerMessage};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// For each message: the properties of its schema, and its examples.
type Contract = BTreeMap<String, (BTreeSet<String>, Vec<String>)>;

fn contract() -> Contract {
    let text = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/openapi/asyncapi.yaml")).unwrap();
    let (_, messages) = text.split_once("\n  messages:\n").unwrap();
    let (mut contract, mut message) = (Contract::new(), String::new());
    for line in messages.lines() {
        let indent = line.len() - line.trim_start().len();
        let (key, value) = line
            .trim_start()
            .split_once(": ")
            .unwrap_or((line.trim().trim_end_matches(':'), ""));
        match (indent, key) {
            (4, name) => name.clone_into(&mut message),
            (10, name) => drop(contract.entry(message.clone()).or_default().0.insert(name.to_owned())),
            (8, "- payload") => contract.entry(message.clone()).or_default().1.push(value.to_owned()),
            _ => {}
        }
    }
    contract
}

/// The message types that the codec lists when it refuses an unknown one.
fn types<T: DeserializeOwned + Debug>() -> BTreeSet<String> {
    let error = Codec::Json
        .decode::<T>(&Message::Text(r#"{"type":"?"}"#.into()))
        .unwrap_err()
        .to_string();
    let (_, known) = error.split_once("expected one of").unwrap();
    known.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

fn replay<T: DeserializeOwned + Serialize + Debug + PartialEq>(contract: &Contract) {
    for name in types::<T>() {
        let (properties, examples) = contract
            .get(&name)
            .unwrap_or_else(|| panic!("{name} is not in the contract"));
        let mut fields = BTreeSet::new();
        for example in examples {
            let typed: T = Codec::Json
                .decode(&Message::Text(example.clone().into()))
                .unwrap_or_else(|error| panic!("{error}: {example}"));
            let Message::Text(text) = Codec::Json.encode(&typed) else {
                panic!()
            };
            let (encoded, example): (Value, Value) = (
                serde_json::from_str(&text).unwrap(),
                serde_json::from_str(example).unwrap(),
            );
            assert_eq!(encoded, example);
            assert_eq!(encoded["type"], name);
            assert_eq!(
                Codec::Msgpack.decode::<T>(&Codec::Msgpack.encode(&typed)).unwrap(),
                typed
            );
            fields.extend(encoded.as_object().unwrap().keys().cloned());
        }
        assert_eq!(&fields, properties, "{name}: the examples' fields and the schema's");
    }
}

#[test]
fn every_message_example_round_trips_through_the_codec() {
    let contract = contract();
    replay::<ClientMessage>(&contract);
    replay::<ServerMessage>(&contract);
    let known = types::<ClientMessage>()
        .union(&types::<ServerMessage>())
        .cloned()
        .collect::<BTreeSet<_>>();
    assert_eq!(known, contract.keys().cloned().collect());
}
