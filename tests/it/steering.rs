//! `foreframe plan` and `foreframe drive`, with the shipped models.

use std::path::Path;

use foreframe_core::frame::codec;
use foreframe_core::types::{Action, RobotState, Seed};
use foreframe_sim::{Scenario, World, WorldConfig};
use serde_json::{Value, json};

use crate::process::{foreframe, text};

/// Runs a command line with the shipped models; gives the exit code, standard output and standard error.
fn run(dir: &Path, line: &str) -> (Option<i32>, String, String) {
    let output = foreframe(dir)
        .args(line.split_whitespace())
        .args(["--models-dir", concat!(env!("CARGO_MANIFEST_DIR"), "/models")])
        .output()
        .unwrap();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// Ten frames of a simulated drive in `look`, with states and actions.
fn record(dir: &Path) {
    let mut world = World::new(Scenario::MovingObserver, &WorldConfig::default(), Seed(3), 1).unwrap();
    let (mut states, mut actions) = (Vec::<RobotState>::new(), Vec::<Action>::new());
    std::fs::create_dir(dir.join("look")).unwrap();
    for index in 0..10 {
        let observation = world.observe();
        let file = dir.join(format!("look/frame-{index}.png"));
        std::fs::write(file, codec::encode_png(&observation.frame).unwrap()).unwrap();
        states.push(observation.state);
        actions.push(world.policy_action());
        world.step(&world.policy_action()).unwrap();
    }
    let file = json!({"states": states, "actions": actions});
    std::fs::write(dir.join("look/actions.json"), file.to_string()).unwrap();
}

const LOOK: &str = "--frames look --actions look/actions.json";

#[test]
fn a_plan_is_found_on_files_and_drawn() {
    let dir = tempfile::tempdir().unwrap();
    record(dir.path());
    let line = format!("plan --model rooms {LOOK} --at 8 --goal 0.4,-0.2 --out plan");
    let (code, said, error) = run(dir.path(), &line);
    assert_eq!(code, Some(0), "{error}");
    assert!(
        said.contains("t+5: ") && said.contains("goal_distance") && said.contains("plans judged"),
        "{said}"
    );
    for picture in ["fan.png", "contact-sheet.png"] {
        assert!(codec::decode(&std::fs::read(dir.path().join("plan").join(picture)).unwrap()).is_ok());
    }
    let written: Value = serde_json::from_slice(&std::fs::read(dir.path().join("plan/plan.json")).unwrap()).unwrap();
    let (_, printed, _) = run(dir.path(), &line.replace("--out plan", "--json"));
    assert_eq!(
        serde_json::from_str::<Value>(&printed).unwrap(),
        written,
        "without a budget, the answer is always the same"
    );
    assert_eq!(written["clearance_checked"], true);
    assert_eq!(written["plan"]["actions"].as_array().unwrap().len(), 5);
    // The actions of the file from that frame on are the present plan.
    let others = written["runners_up"]
        .as_array()
        .unwrap()
        .iter()
        .chain([&written["plan"]]);
    assert!(others.clone().any(|plan| plan["kind"] == "present"));
}

#[test]
fn an_image_can_be_the_goal_of_a_plan() {
    let dir = tempfile::tempdir().unwrap();
    record(dir.path());
    let search = "--solver mppi --samples 8 --iterations 1 --json";
    let line = format!("plan --model moving-flow {LOOK} --at 4 --goal-image look/frame-9.png {search}");
    let (code, said, error) = run(dir.path(), &line);
    assert_eq!(code, Some(0), "{error}");
    let answer: Value = serde_json::from_str(&said).unwrap();
    assert!(
        answer["plan"]["costs"]["goal_image"].as_f64().unwrap() < 0.3,
        "{answer}"
    );
    assert_eq!(answer["clearance_checked"], false);
}

#[test]
fn a_plan_that_cannot_be_made_says_why() {
    let dir = tempfile::tempdir().unwrap();
    record(dir.path());
    for (line, expected) in [
        (format!("plan --model rooms {LOOK}"), "goal is empty"),
        (format!("plan --model static {LOOK} --goal 1,0"), "takes no actions"),
        (format!("plan --model rooms {LOOK} --goal 1"), "two numbers are needed"),
        (
            format!("plan --model rooms {LOOK} --goal 1,0 --solver best"),
            "there are: random-shooting, cem, mppi",
        ),
        (
            format!("plan --model rooms {LOOK} --goal 1,0 --at 2"),
            "--at is 2; it must be 4 to 9",
        ),
        (
            "plan --model moving-flow --frames look --goal 1,0".to_owned(),
            "state is missing",
        ),
    ] {
        let (code, _, error) = run(dir.path(), &line);
        assert_eq!(code, Some(2), "{line}: {error}");
        assert!(error.contains(expected), "{line}: {error}");
    }
}

#[test]
fn drivers_drive_the_same_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let drive =
        "drive --scenario crowded --episodes 2 --seed 4 --duration 4 --driver pid,stop,plan,simulator --model rooms";
    let (code, said, error) = run(dir.path(), &format!("{drive} --json"));
    assert_eq!(code, Some(0), "{error}");
    let scores: Value = serde_json::from_str(&said).unwrap();
    let scores = scores.as_array().unwrap();
    let names: Vec<&str> = scores.iter().map(|driver| driver["driver"].as_str().unwrap()).collect();
    assert_eq!(names, ["pid", "stop", "plan", "simulator"]);
    let goals = |driver: &Value| -> Vec<f64> {
        let episodes = driver["episodes"].as_array().unwrap();
        episodes
            .iter()
            .map(|episode| episode["shortest_m"].as_f64().unwrap())
            .collect()
    };
    assert!(scores.iter().all(|driver| goals(driver) == goals(&scores[0])));
    let (code, _, error) = run(dir.path(), "drive --driver stop --episodes 1 --model moving-flow");
    assert_eq!(code, Some(2));
    assert!(
        error.contains("driver stop needs a model that estimates depth"),
        "{error}"
    );
    let (code, _, error) = run(dir.path(), "drive --driver plan --episodes 1");
    assert_eq!(code, Some(2));
    assert!(error.contains("driver plan needs a model; name one"), "{error}");
}

#[test]
fn an_episode_without_a_goal_is_drawn_again() {
    let dir = tempfile::tempdir().unwrap();
    // In the first room that is drawn for episode 42, the robot starts where it can go nowhere.
    let drive = "drive --scenario crossing --rooms varied --driver pid --seed 5002 --duration 1 --episodes 43 --json";
    let (code, said, error) = run(dir.path(), drive);
    assert_eq!(code, Some(0), "{error}");
    let scores: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(scores[0]["episodes"].as_array().unwrap().len(), 43);
}

/// The number of pictures of a GIF: each has one graphic control extension with the delay of a step, 200 ms.
fn pictures(gif: &[u8]) -> usize {
    assert!(gif.starts_with(b"GIF89a"));
    let control = [0x21, 0xf9, 4];
    let delay = 20u16.to_le_bytes();
    gif.windows(7)
        .filter(|part| part[..3] == control && part[4..6] == delay)
        .count()
}

#[test]
fn a_drive_is_drawn_as_gifs() {
    let dir = tempfile::tempdir().unwrap();
    let drive = "drive --scenario crowded --episodes 2 --seed 4 --duration 8 --driver pid";
    let (code, said, error) = run(dir.path(), &format!("{drive} --out driven"));
    assert_eq!(code, Some(0), "{error}");
    assert!(
        said.contains("driven: drive.json, pid-best.gif, pid-median.gif, pid-worst.gif"),
        "{said}"
    );
    let read = |file: &str| std::fs::read(dir.path().join("driven").join(file)).unwrap();
    let scores: Value = serde_json::from_slice(&read("drive.json")).unwrap();
    let (_, printed, _) = run(dir.path(), &format!("{drive} --json"));
    let printed: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(scores[0]["episodes"], printed[0]["episodes"]);
    let mut episodes: Vec<&Value> = scores[0]["episodes"].as_array().unwrap().iter().collect();
    episodes.sort_by(|one, two| {
        let rank = |episode: &Value| {
            let collisions = episode["collisions"].as_u64().unwrap();
            let is_success = episode["arrived"] == true && collisions == 0;
            (!is_success, collisions, episode["time_s"].as_f64().unwrap())
        };
        rank(one).partial_cmp(&rank(two)).unwrap()
    });
    let steps = |episode: &Value| (episode["time_s"].as_f64().unwrap() / 0.2).round() as usize;
    assert_ne!(
        steps(episodes[0]),
        steps(episodes[1]),
        "one cannot be taken for the other"
    );
    for (file, episode) in [("pid-best.gif", 0), ("pid-median.gif", 1), ("pid-worst.gif", 1)] {
        let gif = read(file);
        assert_eq!(pictures(&gif), steps(episodes[episode]), "{file}");
        assert!(gif.len() < 1_500_000, "{file} has {} bytes", gif.len());
    }
}

#[test]
fn a_drive_that_cannot_be_written_says_why() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("taken"), b"mine").unwrap();
    for (out, expected) in [
        ("taken", "taken exists and is not an empty directory; name a new one"),
        ("taken/inside", "could not make taken/inside: Not a directory"),
    ] {
        let (code, _, error) = run(dir.path(), &format!("drive --episodes 1 --driver pid --out {out}"));
        assert_eq!(code, Some(2), "{error}");
        assert!(error.contains(expected), "{error}");
    }
    assert_eq!(std::fs::read(dir.path().join("taken")).unwrap(), b"mine");
}
