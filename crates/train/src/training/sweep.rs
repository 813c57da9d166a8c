//! A sweep: the same training with every combination of the values of some settings.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::TrainError;

/// The maximum number of trainings of a sweep.
pub const MAX_SWEEP_POINTS: usize = 64;

/// The longest key, in bytes, and the most groups that it names.
const MAX_KEY_BYTES: usize = 100;
const MAX_KEY_GROUPS: usize = 4;

/// Settings with dotted keys, each with the values that it takes in turn.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Sweep(BTreeMap<String, Vec<Value>>);

impl Sweep {
    /// Reads texts such as `seed=1..3` (1, 2 and 3) and `model.channels=32,48`, and checks them.
    /// Errors: `Config`.
    pub fn parse<'a>(texts: impl IntoIterator<Item = &'a str>) -> Result<Self, TrainError> {
        let mut sweep = Self::default();
        for text in texts {
            let Some((key, values)) = text.split_once('=').filter(|(key, _)| !key.trim().is_empty()) else {
                return Err(refused(format!(
                    "\"{text}\" is no sweep; write KEY=VALUE,VALUE or KEY=FIRST..LAST, as in seed=1..3"
                )));
            };
            if sweep.0.insert(key.trim().to_owned(), values_of(values)?).is_some() {
                return Err(refused(format!("\"{}\" is swept twice", key.trim())));
            }
        }
        sweep.check()?;
        Ok(sweep)
    }

    /// Whether no setting is swept.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Checks that keys are short, that each setting has values, none of them twice, and that there are not too many trainings.
    /// Errors: `Config`.
    pub fn check(&self) -> Result<(), TrainError> {
        let too_many = |points: usize| {
            Err(refused(format!(
                "{points} trainings are too many; a sweep has at most {MAX_SWEEP_POINTS}"
            )))
        };
        let mut points = 1_usize;
        for (key, values) in &self.0 {
            if key.len() > MAX_KEY_BYTES || key.matches('.').count() > MAX_KEY_GROUPS {
                let start: String = key.chars().take(20).collect();
                return Err(refused(format!("\"{start}…\" is no setting that can be swept")));
            }
            if values.len() > MAX_SWEEP_POINTS {
                return too_many(values.len());
            }
            if values.is_empty() {
                return Err(refused(format!("\"{key}\" has no values; give at least one")));
            }
            if let Some(twice) = (1..values.len()).find(|&at| values[..at].contains(&values[at])) {
                return Err(refused(format!("\"{key}\" has the value {} twice", values[twice])));
            }
            points = points.saturating_mul(values.len());
        }
        if points > MAX_SWEEP_POINTS {
            return too_many(points);
        }
        Ok(())
    }

    /// The settings of each training, with dotted keys. The values of the last key change first.
    #[must_use]
    pub fn points(&self) -> Vec<Map<String, Value>> {
        let mut points = vec![Map::new()];
        for (key, values) in &self.0 {
            let with_value = |point: &Map<String, Value>, value: &Value| {
                let mut point = point.clone();
                point.insert(key.clone(), value.clone());
                point
            };
            let longer = points
                .iter()
                .flat_map(|point| values.iter().map(move |value| with_value(point, value)));
            points = longer.collect();
        }
        points
    }
}

/// Sets a value in nested settings, by its dotted key. What is in its way is replaced.
pub fn set_nested(settings: &mut Map<String, Value>, key: &str, value: Value) {
    let Some((group, rest)) = key.split_once('.') else {
        settings.insert(key.to_owned(), value);
        return;
    };
    let inner = settings.entry(group).or_insert_with(|| Value::Object(Map::new()));
    if !inner.is_object() {
        *inner = Value::Object(Map::new());
    }
    if let Some(inner) = inner.as_object_mut() {
        set_nested(inner, rest, value);
    }
}

/// The values of `1..3` or `32,48`: numbers, true or false, or texts.
fn values_of(text: &str) -> Result<Vec<Value>, TrainError> {
    if let Some((first, last)) = text.split_once("..") {
        let number = |text: &str| text.trim().parse::<i64>().ok();
        let (Some(first), Some(last)) = (number(first), number(last)) else {
            return Err(refused(format!(
                "\"{text}\" is no range; write two integers, as in 1..3"
            )));
        };
        if last.saturating_sub(first) >= MAX_SWEEP_POINTS as i64 {
            return Err(refused(format!(
                "\"{text}\" has too many values; a sweep has at most {MAX_SWEEP_POINTS} trainings"
            )));
        }
        return Ok((first..=last).map(Value::from).collect());
    }
    let value = |text: &str| serde_json::from_str(text).unwrap_or_else(|_| Value::from(text));
    Ok(text.split(',').map(|text| value(text.trim())).collect())
}

fn refused(reason: String) -> TrainError {
    TrainError::Config(reason)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_sweep_is_every_combination_of_the_values() {
        let sweep = Sweep::parse(["seed=1..2", "sequence.learning_rate=0.1,0.01", "augment=off"]).unwrap();
        let points: Vec<Value> = sweep.points().into_iter().map(Value::Object).collect();
        let point = |seed: i64, rate: f64| json!({"augment": "off", "seed": seed, "sequence.learning_rate": rate});
        assert_eq!(points, [point(1, 0.1), point(1, 0.01), point(2, 0.1), point(2, 0.01)]);
    }

    #[test]
    fn a_sweep_that_is_too_large_or_unclear_is_refused() {
        let refused = |texts: &[&str]| Sweep::parse(texts.iter().copied()).unwrap_err().to_string();
        assert!(refused(&["seed"]).contains("as in seed=1..3"));
        assert!(refused(&["seed=1..65"]).contains("at most 64"));
        assert!(refused(&["seed=1..9", "batch=1..9"]).contains("81 trainings are too many"));
        assert!(refused(&["seed=3..1"]).contains("has no values"));
        assert!(refused(&["seed=1,1"]).contains("has the value 1 twice"));
        assert!(refused(&["seed=a..b"]).contains("is no range"));
        assert!(refused(&["seed=1", "seed=2"]).contains("is swept twice"));
        let deep = format!("{}=1", ["a"; 6].join("."));
        assert!(refused(&[&deep]).contains("is no setting that can be swept"));
        let doubled: Vec<String> = (0..30).map(|at| format!("key{at}=1,2")).collect();
        let doubled: Vec<&str> = doubled.iter().map(String::as_str).collect();
        assert!(refused(&doubled).contains("1073741824 trainings are too many"));
    }

    #[test]
    fn a_dotted_key_is_set_inside_its_group() {
        let mut settings = json!({"model": {"hidden": 8}}).as_object().unwrap().clone();
        set_nested(&mut settings, "model.features", json!(4));
        set_nested(&mut settings, "run.a.b", json!(true));
        let expected = json!({"model": {"hidden": 8, "features": 4}, "run": {"a": {"b": true}}});
        assert_eq!(Value::Object(settings), expected);
    }
}
