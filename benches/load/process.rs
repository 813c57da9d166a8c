//! What a process takes, read from `/proc`.

use std::fs;
use std::time::{Duration, Instant};

/// Ticks of `/proc/PID/stat` in a second: the same on every Linux that people run.
const TICKS_PER_S: f64 = 100.0;

/// A process, by its number or `self`.
#[derive(Clone)]
pub(crate) struct Process(pub(crate) String);

/// What a process takes at a time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Taken {
    pub(crate) rss_mb: f64,
    pub(crate) peak_rss_mb: f64,
    pub(crate) descriptors: usize,
    pub(crate) threads: usize,
}

impl Process {
    fn read(&self, file: &str) -> String {
        let path = format!("/proc/{}/{file}", self.0);
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path}: {error}; has the server ended?"))
    }

    pub(crate) fn taken(&self) -> Taken {
        let status = self.read("status");
        let field = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            let number = line.and_then(|line| line.split_whitespace().next());
            number.and_then(|number| number.parse::<f64>().ok()).unwrap()
        };
        Taken {
            rss_mb: field("VmRSS:") / 1024.0,
            peak_rss_mb: field("VmHWM:") / 1024.0,
            descriptors: fs::read_dir(format!("/proc/{}/fd", self.0)).unwrap().count(),
            threads: field("Threads:") as usize,
        }
    }

    /// Processor time so far.
    pub(crate) fn cpu(&self) -> Duration {
        let stat = self.read("stat");
        // After the name, which may hold anything, but no bracket later.
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

/// The share of a core that a process takes.
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

    /// In percent since it began.
    pub(crate) fn percent(&self) -> f64 {
        100.0 * self.used().as_secs_f64() / self.since.elapsed().as_secs_f64()
    }

    /// Processor time since it began for each of so many, in microseconds.
    pub(crate) fn each_us(&self, count: usize) -> f64 {
        1e6 * self.used().as_secs_f64() / count as f64
    }

    fn used(&self) -> Duration {
        self.process.cpu().saturating_sub(self.before)
    }
}
