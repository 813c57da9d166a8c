//! `foreframe import`

use std::path::PathBuf;

use super::error::CliError;
use super::interrupt;
use super::process::print_line;
use super::progress::ProgressLine;
use super::settings::CommonArgs;
use super::workspace::Workspace;
use foreframe_core::types::DatasetName;
use foreframe_data::dataset::import::{ImportConfig, ImportOptions, import, parse_size};
use foreframe_data::dataset::{DatasetInfo, is_finished};

/// How many left-out items are printed.
const LISTED_ITEMS: usize = 10;

/// Turn a recording into a data set.
///
/// SOURCE is a folder of PNG or JPEG images (with or without a CSV file of times, actions and states), a Donkeycar tub, a
/// `LeRobot` data set, a bag of ROS 2 (.mcap, .db3, or the directory of rosbag2), `NumPy` arrays (.npy, .npz), a video
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
    size: (u32, u32),
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
    let config = ImportConfig {
        source: args.source,
        out: out.clone(),
        options: ImportOptions {
            frame_width_px: args.size.0,
            frame_height_px: args.size.1,
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
    let (name, conditioning) = (&info.name, conditioning(info));
    print_line(format!("next: foreframe inspect {shown}"))?;
    print_line(format!(
        "      foreframe train --preset recording --dataset {shown} --set name={name}{conditioning}"
    ))
}

/// The setting that makes the preset for recordings fit the data set's channels.
fn conditioning(info: &DatasetInfo) -> &'static str {
    match (info.action_channels.is_empty(), info.state_channels.is_empty()) {
        (false, false) => " --set model.conditioning=state-action",
        (false, true) => "",
        (true, false) => " --set model.conditioning=state",
        (true, true) => " --set model.conditioning=none",
    }
}

/// The data set's name: the one given, or one made of the source's. Errors: `Usage` if the given name is not valid.
fn name(args: &ImportArgs) -> Result<DatasetName, CliError> {
    if let Some(name) = &args.name {
        return name.parse().map_err(|_| {
            CliError::Usage(format!(
                "--name is {name:?}; a name has 1 to 64 characters of a to z, 0 to 9 and -, and does not start with -"
            ))
        });
    }
    let source = args.source.canonicalize().unwrap_or_else(|_| args.source.clone());
    let stem = source.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
    let stem = stem.strip_suffix(".tar").unwrap_or(&stem);
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    let name: String = stem.chars().map(allowed).take(64).collect();
    let name = name.trim_matches('-');
    let name = if name.is_empty() { "recording" } else { name };
    Ok(name.parse().expect("a data set's name with other characters is a bug"))
}
