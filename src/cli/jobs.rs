//! `foreframe jobs`

use std::time::Duration;

use indicatif::HumanDuration;

use super::error::CliError;
use super::process::print_line;
use super::settings::{CommonArgs, open_store, with_checked_directories};
use super::sweep_table;
use super::table::aligned;
use super::workspace::{Workspace, block_on};
use crate::server::start_jobs;
use foreframe_core::error_text::comma_separated;
use foreframe_jobs::jobs::{Job, JobFilter, JobParts, JobState, Jobs};
use foreframe_jobs::store::{Author, JobId};

/// Lines of a log that are read at once.
const LOG_PAGE: usize = 1000;

/// List, show and cancel the jobs of a server's store.
///
/// Jobs are submitted over HTTP or on the server's page, and run by `foreframe serve` or `foreframe worker` with the same
/// directories.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe jobs list
  foreframe jobs show job-3
  foreframe jobs log job-3
  foreframe jobs cancel job-3 --data-dir /var/lib/foreframe")]
pub(super) struct JobsArgs {
    #[command(subcommand)]
    action: JobsCommand,
    #[command(flatten)]
    settings: CommonArgs,
}

#[derive(clap::Subcommand)]
enum JobsCommand {
    /// List jobs, the newest first
    #[command(after_help = "Example:\n  foreframe jobs list --state running")]
    List {
        /// Only jobs in that state: queued, running, succeeded, failed or cancelled
        #[arg(long)]
        state: Option<JobState>,
        /// Only the parts of that job; without it, the list has no parts
        #[arg(long, value_name = "JOB")]
        part_of: Option<JobId>,
        /// How many at most
        #[arg(long, default_value_t = 50)]
        limit: u32,
        /// Print JSON instead of text
        #[arg(long)]
        json: bool,
    },
    /// Describe a job
    #[command(after_help = "Example:\n  foreframe jobs show job-3")]
    Show {
        /// The job's id, as in the list
        id: JobId,
        /// Print JSON instead of text
        #[arg(long)]
        json: bool,
    },
    /// Print a job's log, each line with the seconds since the first
    #[command(after_help = "Example:\n  foreframe jobs log job-3")]
    Log {
        /// The job's id, as in the list
        id: JobId,
    },
    /// Cancel a job: one that waits ends at once, one that runs at its next checkpoint
    #[command(after_help = "Example:\n  foreframe jobs cancel job-3")]
    Cancel {
        /// The job's id, as in the list
        id: JobId,
    },
}

pub(super) fn run(args: &JobsArgs) -> Result<(), CliError> {
    let loaded = args.settings.load()?;
    let workspace = Workspace::new(with_checked_directories(loaded)?);
    let server = &workspace.config.server;
    if !server.store().exists() {
        return Err(CliError::Usage(format!(
            "there are no jobs in {}; name the data directory of a server with --data-dir",
            server.data_dir.display()
        )));
    }
    block_on(async {
        let versions = workspace.versions().await?;
        let store = open_store(&workspace.config).await?;
        let jobs = start_jobs(server, &store, &versions, false)?;
        match &args.action {
            JobsCommand::List {
                state,
                part_of,
                limit,
                json,
            } => {
                let filter = JobFilter {
                    state: *state,
                    part_of: part_of.map(|id| id.to_string()),
                    limit: *limit as usize,
                    ..JobFilter::default()
                };
                list(&jobs, filter, *json).await
            }
            JobsCommand::Show { id, json } => show(&jobs.get(*id).await?, *json),
            JobsCommand::Log { id } => log(&jobs, *id).await,
            JobsCommand::Cancel { id } => cancel(&jobs, *id).await,
        }
    })
}

async fn list(jobs: &Jobs, filter: JobFilter, is_json: bool) -> Result<(), CliError> {
    let found = jobs.list(filter).await?;
    if is_json {
        return print_line(serde_json::to_string_pretty(&found).map_err(CliError::failed)?);
    }
    if found.is_empty() {
        return print_line("there are no such jobs");
    }
    let rows: Vec<[String; 5]> = found.iter().map(row).collect();
    let mut lines = aligned(["job", "kind", "state", "done", "what"], &rows).into_iter();
    lines.try_for_each(print_line)
}

fn row(job: &Job) -> [String; 5] {
    [
        job.id.to_string(),
        job.spec.kind().to_owned(),
        state(job),
        share_done(job),
        job.error
            .clone()
            .unwrap_or_else(|| format!("data set {}", comma_separated(&job.spec.datasets()))),
    ]
}

fn state(job: &Job) -> String {
    let stopping = if job.cancelling { ", will stop" } else { "" };
    format!("{}{stopping}", job.state)
}

fn share_done(job: &Job) -> String {
    let (done, total) = (job.progress.done, job.progress.total);
    match total {
        0 => "–".to_owned(),
        total => format!("{done}/{total}"),
    }
}

fn show(job: &Job, is_json: bool) -> Result<(), CliError> {
    if is_json {
        return print_line(serde_json::to_string_pretty(job).map_err(CliError::failed)?);
    }
    let spec = serde_json::to_string(&job.spec).map_err(CliError::failed)?;
    print_line(format!("{}: {}, {}", job.id, job.spec.kind(), state(job)))?;
    print_line(format!("  asked for  {spec}"))?;
    print_line(format!("  done       {} {}", share_done(job), job.progress.message))?;
    if let Some(parts) = &job.parts {
        let JobParts {
            total,
            done,
            running,
            failed,
        } = parts;
        print_line(format!(
            "  parts      {total}: {done} done, {running} running, {failed} failed"
        ))?;
    }
    if let Some(left_s) = job
        .progress
        .remaining_s
        .and_then(|left_s| Duration::try_from_secs_f64(left_s).ok())
    {
        print_line(format!("  left       {}", HumanDuration(left_s)))?;
    }
    if let Some(ended_s) = job.ended_unix_s {
        let ran = Duration::try_from_secs_f64(ended_s - job.started_unix_s.unwrap_or(ended_s)).unwrap_or_default();
        print_line(format!("  took       {}", HumanDuration(ran)))?;
    }
    print_line(format!("  attempts   {}", job.attempts))?;
    if let Some(error) = &job.error {
        print_line(format!("  error      {error}"))?;
    }
    match &job.result {
        Some(result) => match sweep_table::rows_of(result) {
            Some(rows) => {
                let mut lines = sweep_table::lines(&rows, "version").into_iter();
                lines.try_for_each(|line| print_line(format!("  {line}")))
            }
            None => print_line(format!("  result     {result}")),
        },
        None => Ok(()),
    }
}

async fn log(jobs: &Jobs, id: JobId) -> Result<(), CliError> {
    let (mut after, mut first_s) = (0, None);
    loop {
        let lines = jobs.log(id, after, LOG_PAGE).await?;
        for line in &lines {
            let since_s = line.time_s - *first_s.get_or_insert(line.time_s);
            print_line(format!("{since_s:8.1}  {}", line.line))?;
        }
        match lines.last() {
            Some(last) if lines.len() == LOG_PAGE => after = last.seq,
            _ => return Ok(()),
        }
    }
}

async fn cancel(jobs: &Jobs, id: JobId) -> Result<(), CliError> {
    let job = jobs.cancel(id, &Author::CommandLine).await?;
    print_line(if job.state == JobState::Cancelled {
        format!("{id} is cancelled")
    } else {
        format!("{id} will stop at its next checkpoint")
    })
}
