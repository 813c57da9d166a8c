//! `foreframe bridge`

use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tracing::warn;

use super::error::CliError;
use super::interrupt;
use super::process::print_line;
use super::settings::CommonArgs;
use super::workspace::Workspace;
use crate::bridge::{self, BridgeEvent, BridgeSettings, LiveStep, RobotAddress, TopicNames};

/// How often a line says how it goes.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// The seconds that an option takes.
const SECONDS: RangeInclusive<f64> = 0.1..=86_400.0;

/// Predict for a running robot that has a Foxglove bridge.
///
/// It subscribes to the robot's camera and, if the model takes them, its command and odometry. It publishes three ROS 2 topics on the robot:
/// `PREFIX/predicted`, the last predicted frame with its time (a CompressedImage); `PREFIX/error`, the error of the earlier prediction for
/// the present frame (mean squared, a Float64); `PREFIX/expected_error`, the error to expect of that last predicted frame (a
/// Float64). Images are `sensor_msgs/msg/Image` or CompressedImage in CDR, or `foxglove.RawImage` or CompressedImage. Commands and odometry
/// are messages of ROS 2 in CDR or JSON; a topic that is named can also have any other object in JSON, whose numbers are found by the
/// names of the model's channels. The program ends when the robot closes the connection, or when nothing comes from it for some seconds.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe bridge ws://192.168.1.20:8765 --model rooms
  foreframe bridge ws://localhost:8765 --model mycar --image /camera/image_raw --state /odom
  foreframe bridge wss://robot-7.local:8765 --model rooms --ca-certificate robot-7.pem")]
pub(super) struct BridgeArgs {
    /// The robot's address, as ws://HOST:PORT or wss://HOST:PORT
    address: String,
    /// A PEM file with the certificates to trust for wss:// [default: those that the system trusts]
    #[arg(long, value_name = "FILE")]
    ca_certificate: Option<PathBuf>,
    /// The directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: String,
    /// The topic of the camera [default: the first one with images]
    #[arg(long, value_name = "TOPIC")]
    image: Option<String>,
    /// The topic of the command [default: the first Twist or TwistStamped]
    #[arg(long, value_name = "TOPIC")]
    action: Option<String>,
    /// The topic of the odometry [default: the first Odometry or JointState]
    #[arg(long, value_name = "TOPIC")]
    state: Option<String>,
    /// What the names of the published topics begin with
    #[arg(long, value_name = "PREFIX", default_value = "/foreframe")]
    prefix: String,
    /// End when nothing came from the robot for so many seconds, not even the answer to a ping
    #[arg(long, value_name = "S", default_value = "10", value_parser = seconds)]
    idle_limit: Duration,
    /// The age in seconds up to which a state is used as the present one
    #[arg(long, value_name = "S", default_value = "1", value_parser = seconds)]
    state_age_limit: Duration,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: BridgeArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (_, model) = workspace.load_model(&args.model)?;
    let settings = BridgeSettings {
        address: RobotAddress {
            url: args.address,
            ca_certificate: args.ca_certificate,
            idle_limit: args.idle_limit,
        },
        names: TopicNames {
            image: args.image,
            action: args.action,
            state: args.state,
            prefix: args.prefix,
        },
        state_age_limit: args.state_age_limit,
    };
    let cancelled = interrupt::flag()?;
    let mut log = BridgeLog::default();
    bridge::run(
        &settings,
        &Arc::new(model),
        &mut |event| log.on_event(event),
        &cancelled,
    )?;
    Ok(())
}

fn seconds(text: &str) -> Result<Duration, String> {
    let parsed = text.parse().ok().filter(|seconds| SECONDS.contains(seconds));
    let wrong = || format!("give a number of seconds, {} to {}", SECONDS.start(), SECONDS.end());
    parsed.map(Duration::from_secs_f64).ok_or_else(wrong)
}

/// Prints what happens, and now and then how it goes.
#[derive(Default)]
struct BridgeLog {
    frames: u64,
    latest: LiveStep,
    printed: Option<Instant>,
    complained: Option<Instant>,
}

impl BridgeLog {
    fn on_event(&mut self, event: BridgeEvent) {
        let line = match event {
            BridgeEvent::LeftOut(error) => {
                if self.complained.is_none_or(|at| at.elapsed() >= LINE_EVERY) {
                    self.complained = Some(Instant::now());
                    warn!("left out: {error}");
                }
                return;
            }
            BridgeEvent::Notice(text) => {
                warn!("{text}");
                return;
            }
            BridgeEvent::Connected(name) => format!("connected to \"{name}\""),
            BridgeEvent::Subscribed { role, topic } => format!("{}: {topic}", bridge::word(role)),
            BridgeEvent::Predicted(step) => {
                self.frames += 1;
                self.latest = step;
                if self.printed.is_some_and(|printed| printed.elapsed() < LINE_EVERY) {
                    return;
                }
                self.printed = Some(Instant::now());
                let error = self
                    .latest
                    .error
                    .map_or(String::new(), |error| format!(", error {error:.4}"));
                format!("{} frames{error}", self.frames)
            }
        };
        // If standard output is closed, the bridge still works for the robot.
        let _ = print_line(line);
    }
}
