//! Many robots at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use foreframe::server::protocol::OnLate;
use futures_util::future::join_all;
use tokio::sync::mpsc;
use tokio::time::sleep_until;

use crate::figures::Latencies;
use crate::http::Http;
use crate::material::Material;
use crate::pace::Pace;
use crate::process::{CpuShare, Process};
use crate::robot::{self, Answer, Tally};
use crate::server::Server;
use crate::session::{self, Session};

/// Between the last robot's being ready and the first frame.
const LEAD: Duration = Duration::from_millis(100);

/// When robots send.
#[derive(Clone, Copy)]
pub(crate) enum Drive {
    /// At times, this many frames a second and robot, however late the socket takes them.
    Paced(f64),
    /// The same, but a frame that the socket has no room for when the next one is due is never sent: robots want the
    /// present.
    Fresh(f64),
    /// This many frames ahead of the answers.
    Closed(usize),
}

/// What robots do: some time that does not count, for a hundred sockets that open at once are another question, and
/// some that does.
#[derive(Clone, Copy)]
pub(crate) struct Flight {
    pub(crate) sessions: usize,
    pub(crate) drive: Drive,
    /// What frames mean that newer ones have overtaken.
    pub(crate) on_late: OnLate,
    pub(crate) warm_up: Duration,
    pub(crate) measured: Duration,
}

/// What came of it.
pub(crate) struct Flown {
    pub(crate) tally: Tally,
    /// Frames that were never sent, since the socket had no room.
    pub(crate) held_back: u64,
    /// Percent of a core.
    pub(crate) server_cpu: f64,
    pub(crate) own_cpu: f64,
    from: Instant,
    to: Instant,
}

impl Flight {
    pub(crate) async fn run(&self, server: &Server, material: &Arc<Material>) -> Flown {
        let mut http = Http::new(server.address);
        let (mut sessions, mut sockets) = (Vec::new(), Vec::new());
        for _ in 0..self.sessions {
            let session = Session::open(&mut http, material.model(), self.on_late).await;
            let socket = session::connect(server.address, &session.stream_path()).await;
            sockets.push(socket.expect("a stream"));
            sessions.push(session);
        }
        let begin = Instant::now() + LEAD;
        let (from, to) = (begin + self.warm_up, begin + self.warm_up + self.measured);
        let (mut cues, mut robots) = (Vec::new(), Vec::new());
        for socket in sockets {
            let (cue, of_robot) = mpsc::channel(self.cues_ahead());
            let answered = self.answered(cue.clone(), to);
            robots.push(tokio::spawn(robot::fly(
                socket,
                Arc::clone(material),
                of_robot,
                answered,
            )));
            cues.push(cue);
        }
        let held_back = self.start(begin, cues);
        sleep_until(from.into()).await;
        let shares = [&server.process.0, "self"].map(|process| CpuShare::begin(Process(process.to_owned())));
        sleep_until(to.into()).await;
        let [server_cpu, own_cpu] = shares.map(|share| share.percent());
        let mut tally = Tally::default();
        for robot in join_all(robots).await {
            tally.add(robot.unwrap());
        }
        for session in sessions {
            http.expect(204, &session.deletion()).await;
        }
        Flown {
            tally,
            held_back: held_back.load(Ordering::Relaxed),
            server_cpu,
            own_cpu,
            from,
            to,
        }
    }

    fn cues_ahead(&self) -> usize {
        match self.drive {
            Drive::Paced(rate_hz) => 1 + (rate_hz * (self.warm_up + self.measured).as_secs_f64()).ceil() as usize,
            Drive::Fresh(_) => 1,
            Drive::Closed(ahead) => ahead,
        }
    }

    /// What a robot does after an answer: in a closed loop, the next frame.
    fn answered(&self, cue: mpsc::Sender<Instant>, to: Instant) -> impl FnMut() + Send + use<> {
        let mut cue = matches!(self.drive, Drive::Closed(_)).then_some(cue);
        move || {
            let now = Instant::now();
            cue = cue.take().filter(|_| now < to);
            if let Some(cue) = &cue {
                // Full only if the socket has no room either; then there are cues enough.
                let _ = cue.try_send(now);
            }
        }
    }

    /// Starts the robots, in turn, as robots are; counts the frames that are held back.
    fn start(&self, begin: Instant, cues: Vec<mpsc::Sender<Instant>>) -> Arc<AtomicU64> {
        let held_back = Arc::new(AtomicU64::new(0));
        match self.drive {
            Drive::Closed(ahead) => {
                for cue in cues.iter().flat_map(|cue| std::iter::repeat_n(cue, ahead)) {
                    cue.try_send(begin).expect("room for the first cues");
                }
            }
            Drive::Paced(rate_hz) | Drive::Fresh(rate_hz) => {
                let pace = Pace::lasting(begin, rate_hz * cues.len() as f64, self.warm_up + self.measured);
                let count = Arc::clone(&held_back);
                pace.start(move |tick| {
                    let cue = &cues[tick.index as usize % cues.len()];
                    if cue.try_send(tick.scheduled).is_err() {
                        count.fetch_add(1, Ordering::Relaxed);
                    }
                });
            }
        }
        held_back
    }
}

impl Flown {
    /// Of the predictions whose frames were due in the time that counts.
    pub(crate) fn latencies(&self, of: impl Fn(&Answer) -> Duration) -> Latencies {
        let counted = self.tally.answers.iter();
        Latencies::of(
            counted
                .filter(|answer| (self.from..self.to).contains(&answer.scheduled))
                .map(of),
        )
    }

    pub(crate) fn since_schedule(&self) -> Latencies {
        self.latencies(|answer| answer.came - answer.scheduled)
    }

    /// The server's processor time for each of the predictions that came in the time that counts, in microseconds.
    pub(crate) fn each_us(&self) -> f64 {
        1e4 * self.server_cpu / self.goodput_hz()
    }

    /// Predictions a second that came in the time that counts.
    pub(crate) fn goodput_hz(&self) -> f64 {
        let came = |answer: &&Answer| (self.from..self.to).contains(&answer.came);
        self.tally.answers.iter().filter(came).count() as f64 / (self.to - self.from).as_secs_f64()
    }
}
