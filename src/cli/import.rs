//! `foreframe import`

use std::path::{Path, PathBuf};

use super::error::CliError;
use super::interrupt;
use super::next_step::{first_trainable, name_from, shell_path};
use super::process::print_line;
use super::progress::ProgressLine;
use super::settings::CommonArgs;
use super::workspace::{Workspace, dataset_name};
use foreframe_core::frame::FrameSize;
use foreframe_core::types::DatasetName;
use foreframe_data::dataset::import::{ImportConfig, ImportOptions, import, parse_size};
use foreframe_data::dataset::{DatasetInfo, is_finished};
use foreframe_train::training::TrainConfig;

/// How many left-out items are printed.
const LISTED_ITEMS: usize = 10;
/// The preset for recordings.
const PRESET: &str = "recording";

/// Turn a recording into a data set.
///
/// SOURCE is a folder of PNG or JPEG images (with or without a CSV file of times, actions and states), a Donkeycar tub, a
/// LeRobot data set, a bag of ROS 2 (.mcap, .db3, or the directory of rosbag2), NumPy arrays (.npy, .npz), a video
/// (needs ffmpeg), or an archive of one of these (.zip, .tar, .tar.gz). Images become gray and get one size. Gaps in time split episodes. If you stop it, run the same command again:
/// it continues.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe import ~/mycar/data --name mycar --every 4
  foreframe import frames/ --name walk --rate 10
  foreframe import frames/ --csv log.csv --action speed --action turn --unit turn=rad/s
  foreframe import pusht/ --image front --size 96x96
  foreframe import drive.mcap --image /camera/image_raw --action /cmd_vel --state /odom --rate 10
  foreframe import walk.zip --rate 10
  foreframe import mnist_test_seq.npy --name mnist-test-seq --rate 10
then
  foreframe inspect mycar
  foreframe train --preset recording --dataset mycar --set name=mycar")]
pub(super) struct ImportArgs {
    /// A folder of images, a Donkeycar tub, a LeRobot data set, a bag of ROS 2, a .npy or .npz file, a video, or an archive
    source: PathBuf,
    /// The data set's name [default: the source's name]
    #[arg(long)]
    name: Option<String>,
    /// The data set's directory [default: `DATA_DIR/datasets/NAME`]
    #[arg(long, value_name = "DIR", conflicts_with = "name")]
    out: Option<PathBuf>,
    /// Width and height of the frames in pixels, as in 64x64
    #[arg(long, value_name = "WxH", default_value = "64x64", value_parser = parse_size)]
    size: FrameSize,
    #[command(flatten)]
    options: ImportOptions,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: ImportArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let out = match &args.out {
        Some(out) => out.clone(),
        None => workspace.datasets_dir().join(name(&args)?),
    };
    let flags = args.settings.repeated();
    let config = ImportConfig {
        source: args.source,
        out: out.clone(),
        options: ImportOptions {
            frame_width_px: args.size.width,
            frame_height_px: args.size.height,
            ..args.options
        },
        disk_mib: workspace.config.server.import_disk_mib,
        max_files: workspace.config.server.max_import_files,
    };
    let was_complete = is_finished(&out);
    let (cancelled, progress) = (interrupt::flag()?, ProgressLine::new("frames"));
    progress.label("importing");
    let imported = import(
        &config,
        &|now| progress.update(now.done, now.total, String::new),
        &cancelled,
    );
    progress.finish();
    let imported = imported?;
    let (info, shown) = (&imported.info, out.display());
    if was_complete {
        print_line("already imported before, and not read again; delete the directory to import the source anew")?;
    }
    print_line(format!(
        "{shown}: {} episodes, {} frames of {}×{} px, {:.4} s apart, content {}",
        info.episode_count,
        info.frame_count,
        info.frame_width_px,
        info.frame_height_px,
        info.frame_period_s,
        info.content_hash
    ))?;
    if !imported.skipped.is_empty() {
        print_line(format!("left out {} damaged items:", imported.skipped_count()))?;
        for item in imported.skipped.iter().take(LISTED_ITEMS) {
            print_line(format!("  {}: {}", item.place, item.reason))?;
        }
        if imported.skipped.len() > LISTED_ITEMS {
            let list = out.join("meta/skipped.json");
            print_line(format!("  … more of them are in {}", list.display()))?;
        }
    }
    for note in &imported.notes {
        print_line(format!("note: {note}"))?;
    }
    next_steps(&out, info, &flags)
}

/// Prints the commands that work on the data set.
fn next_steps(out: &Path, info: &DatasetInfo, flags: &str) -> Result<(), CliError> {
    let dataset = shell_path(out);
    print_line(format!("next: foreframe inspect {dataset}{flags}"))?;
    let config = TrainConfig::layered(PRESET, None, &conditioning(info))?;
    // A tenth of the frames is for validation, a tenth for tests, and windows across a cut are left out.
    let least = 20 * (config.model.context + config.model.horizon);
    if first_trainable(out, info, [config])?.is_none() {
        let episodes = match info.episode_count {
            1 => "one episode".to_owned(),
            count => format!("{count} episodes"),
        };
        return print_line(format!(
            "      record more before you train: {} frames in {episodes} are too few for training and validation; a recording \
             without a break needs about {least}",
            info.frame_count
        ));
    }
    let mut settings = vec![format!("name={}", name_from(&info.name, "recording"))];
    settings.extend(conditioning(info));
    let settings = settings.join(" --set ");
    print_line(format!(
        "      foreframe train --preset {PRESET} --dataset {dataset} --set {settings}{flags}"
    ))
}

/// The setting that makes the preset for recordings fit the data set's channels, if it needs one.
fn conditioning(info: &DatasetInfo) -> Vec<String> {
    let conditioning = match (info.action_channels.is_empty(), info.state_channels.is_empty()) {
        (false, false) => "state-action",
        (false, true) => return Vec::new(),
        (true, false) => "state",
        (true, true) => "none",
    };
    vec![format!("model.conditioning={conditioning}")]
}

/// The data set's name: the one given, or one made of the source's. Errors: `Usage` if the given name is not valid.
fn name(args: &ImportArgs) -> Result<DatasetName, CliError> {
    if let Some(name) = &args.name {
        return dataset_name(name);
    }
    let source = args.source.canonicalize().unwrap_or_else(|_| args.source.clone());
    let stem = source.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
    let name = name_from(stem.strip_suffix(".tar").unwrap_or(&stem), "recording");
    Ok(name.parse().expect("a data set's name with other characters is a bug"))
}
