//! The answer of a search, as text and as JSON.

use serde_json::{Value, json as object};

use crate::cli::error::CliError;
use crate::cli::process::print_line;
use crate::cli::table::aligned;
use foreframe_core::planning::{PlanCandidate, PlanChoice};
use foreframe_core::registry::Manifest;
use foreframe_core::types::Action;

/// The answer, with the names of a server's.
pub(super) fn json(manifest: &Manifest, choice: &PlanChoice) -> Value {
    object!({
        "model": manifest.name,
        "version": manifest.version,
        "plan": candidate(&choice.best),
        "runners_up": choice.runners_up.iter().map(candidate).collect::<Vec<_>>(),
        "safe": choice.unsafe_reason.is_none(),
        "reason": choice.unsafe_reason,
        "clearance_checked": choice.clearance_checked,
        "obstacles": {
            "fixed_m": choice.obstacles.fixed_m(),
            "movers_m": choice.obstacles.movers_m(),
        },
        "samples": choice.samples,
        "predicted": choice.predicted,
        "iterations": choice.iterations,
    })
}

fn candidate(candidate: &PlanCandidate) -> Value {
    let costs: serde_json::Map<String, Value> = (candidate.costs.iter())
        .map(|(cost, value)| (cost.name().to_owned(), object!(value)))
        .collect();
    let way = candidate.motion.as_ref().map(|motion| {
        let places = motion.iter().map(|[yaw, ahead, left]| [*ahead, *left, *yaw]);
        places.collect::<Vec<_>>()
    });
    object!({
        "kind": candidate.kind,
        "actions": candidate.actions.iter().map(Action::as_slice).collect::<Vec<_>>(),
        "cost": candidate.total,
        "costs": costs,
        "way": way,
        "clearance_m": candidate.clearance_m.filter(|clearance| clearance.is_finite()),
        "expected_mse": candidate.rollout.as_ref().map(foreframe_core::serving::Rollout::expected_mse),
    })
}

/// Prints the best plan and how it compares.
pub(super) fn print_choice(manifest: &Manifest, choice: &PlanChoice) -> Result<(), CliError> {
    if let Some(reason) = choice.unsafe_reason {
        print_line(format!("no plan is safe: {reason}; stop"))?;
    }
    let channels: Vec<String> = manifest.spec.actions.iter().map(ToString::to_string).collect();
    print_line(format!("plan ({}):", channels.join(", ")))?;
    for (step, action) in choice.best.actions.iter().enumerate() {
        let values: Vec<String> = action.as_slice().iter().map(|value| format!("{value:.3}")).collect();
        let place = choice.best.motion.as_ref().and_then(|motion| motion.get(step));
        let place = place.map_or(String::new(), |[yaw, ahead, left]| {
            format!("  then {ahead:.2} m ahead, {left:.2} m to the left, turned {yaw:.2} rad")
        });
        print_line(format!("t+{}: {}{place}", step + 1, values.join(", ")))?;
    }
    let all = std::iter::once(&choice.best).chain(&choice.runners_up);
    let rows: Vec<[String; 4]> = all.map(row).collect();
    for line in aligned(["plan", "cost", "clearance m", "costs"], &rows) {
        print_line(line)?;
    }
    if !choice.clearance_checked {
        let sees_depth = manifest.spec.flow().is_some_and(|flow| flow.layers.depth);
        print_line(if sees_depth {
            "the way was not checked: the model's actions are not speeds (m/s and rad/s)"
        } else {
            "the way was not checked: this model does not estimate depth (\"rooms\" does)"
        })?;
    }
    print_line(format!(
        "{} plans judged, {} of them predicted",
        choice.samples, choice.predicted
    ))
}

fn row(candidate: &PlanCandidate) -> [String; 4] {
    let clearance = match candidate.clearance_m {
        None => "-".to_owned(),
        Some(clearance) if clearance.is_infinite() => "nothing seen".to_owned(),
        Some(clearance) => format!("{clearance:.2}"),
    };
    let costs = candidate.costs.iter().map(|(cost, value)| {
        let space = if cost.unit().is_empty() { "" } else { " " };
        format!("{} {value:.3}{space}{}", cost.name(), cost.unit())
    });
    let kind = format!("{:?}", candidate.kind).to_lowercase();
    [
        kind,
        format!("{:.3}", candidate.total),
        clearance,
        costs.collect::<Vec<_>>().join(", "),
    ]
}
