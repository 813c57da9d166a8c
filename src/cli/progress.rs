//! Progress on standard error: a bar on a terminal, a line every few seconds in a log.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressStyle};

/// How often a line is written where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// A count towards a total.
pub(super) struct ProgressLine {
    bar: ProgressBar,
    unit: &'static str,
    last_line: Option<Mutex<Instant>>,
}

impl ProgressLine {
    /// Counts `unit`s, of which the total is not known yet.
    pub(super) fn new(unit: &'static str) -> Self {
        let bar = ProgressBar::new(0);
        let template = "{prefix} {bar:30} {human_pos}/{human_len} {per_sec} {eta} left {msg}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        let last_line = (!std::io::stderr().is_terminal()).then(|| Mutex::new(Instant::now()));
        Self { bar, unit, last_line }
    }

    /// Names what is counted now, and starts it anew at `done`.
    pub(super) fn start(&self, what: &str, done: u64, total: u64) {
        self.bar.set_prefix(what.to_owned());
        self.bar.set_length(total);
        self.bar.reset();
        self.bar.set_position(done);
        // What a former run did is no speed of this one.
        self.bar.reset_eta();
    }

    /// Tells how many are done, with a message behind.
    pub(super) fn update(&self, done: u64, total: u64, message: impl FnOnce() -> String) {
        self.bar.set_length(total);
        self.bar.set_position(done);
        let Some(last_line) = &self.last_line else {
            self.bar.set_message(message());
            return;
        };
        let Ok(mut last) = last_line.lock() else { return };
        if last.elapsed() < LINE_INTERVAL && done < total {
            return;
        }
        *last = Instant::now();
        let (rate, left) = (self.bar.per_sec(), HumanDuration(self.bar.eta()));
        self.line(&format!(
            "{}/{total} {}, {rate:.1}/s, {left} left {}",
            done,
            self.unit,
            message()
        ));
    }

    /// Writes a line above the bar.
    pub(super) fn line(&self, text: &str) {
        if self.last_line.is_some() {
            eprintln!("{} {text}", self.bar.prefix());
        } else {
            self.bar.println(text);
        }
    }

    /// Takes the bar away.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
