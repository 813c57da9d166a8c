//! Memory, file descriptors, threads and processor time of a process, read from `/proc`.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

/// Ticks of `/proc/PID/stat` per second: the same on all common Linux systems.
const TICKS_PER_S: f64 = 100.0;
/// Part of the names of the database's files.
const DATABASE: &str = "foreframe.db";
/// Prefix of the names of the database's threads.
const DATABASE_THREAD: &str = "sqlx-";

/// A process, by its number or `self`.
#[derive(Clone)]
pub(crate) struct Process(pub(crate) String);

/// Resources that a process uses at one time. File descriptors and threads of database connections are not counted: their
/// number is bounded, and they are opened on demand.
#[derive(Clone, Copy)]
pub(crate) struct Usage {
    pub(crate) rss_mib: f64,
    pub(crate) peak_rss_mib: f64,
    pub(crate) descriptors: usize,
    pub(crate) threads: usize,
}

impl Process {
    fn read(&self, file: &str) -> String {
        let path = format!("/proc/{}/{file}", self.0);
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path}: {error}; has the server ended?"))
    }

    pub(crate) fn usage(&self) -> Usage {
        let status = self.read("status");
        let field = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            let number = line.and_then(|line| line.split_whitespace().next());
            number.and_then(|number| number.parse::<f64>().ok()).unwrap()
        };
        Usage {
            rss_mib: field("VmRSS:") / 1024.0,
            peak_rss_mib: field("VmHWM:") / 1024.0,
            descriptors: self.count("fd", |entry| {
                // A descriptor that was closed in the meantime does not count.
                fs::read_link(entry).is_ok_and(|target| !target.to_string_lossy().contains(DATABASE))
            }),
            threads: self.count("task", |entry| {
                fs::read_to_string(entry.join("comm")).is_ok_and(|name| !name.starts_with(DATABASE_THREAD))
            }),
        }
    }

    fn count(&self, dir: &str, is_counted: impl Fn(&Path) -> bool) -> usize {
        let entries = fs::read_dir(format!("/proc/{}/{dir}", self.0)).unwrap();
        entries
            .filter(|entry| is_counted(&entry.as_ref().unwrap().path()))
            .count()
    }

    /// Processor time used so far.
    pub(crate) fn cpu(&self) -> Duration {
        let stat = self.read("stat");
        // The name comes first and may contain anything; the last bracket ends it.
        let (_, fields) = stat.rsplit_once(')').unwrap();
        let ticks: f64 = fields
            .split_whitespace()
            .skip(11)
            .take(2)
            .map(|ticks| ticks.parse::<f64>().unwrap())
            .sum();
        Duration::from_secs_f64(ticks / TICKS_PER_S)
    }
}

/// Processor time that a process uses in an interval.
pub(crate) struct CpuShare {
    process: Process,
    since: Instant,
    before: Duration,
}

impl CpuShare {
    pub(crate) fn begin(process: Process) -> Self {
        Self {
            since: Instant::now(),
            before: process.cpu(),
            process,
        }
    }

    /// Percent of a core since the start of the interval.
    pub(crate) fn percent(&self) -> f64 {
        100.0 * self.used().as_secs_f64() / self.since.elapsed().as_secs_f64()
    }

    /// Microseconds of processor time per item, for `count` items since the start of the interval.
    pub(crate) fn each_us(&self, count: usize) -> f64 {
        1e6 * self.used().as_secs_f64() / count as f64
    }

    fn used(&self) -> Duration {
        self.process.cpu().saturating_sub(self.before)
    }
}
