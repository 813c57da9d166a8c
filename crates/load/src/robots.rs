//! Many robots that stream at the same time.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use foreframe::server::protocol::OnLate;
use futures_util::future::join_all;
use tokio::sync::mpsc;
use tokio::time::sleep_until;

use crate::http::Http;
use crate::process_usage::{CpuShare, Process};
use crate::report::Latencies;
use crate::robot::{self, FrameCounts, PredictionTimes};
use crate::schedule::Schedule;
use crate::server::Server;
use crate::session::{self, Session};
use crate::workload::Workload;

/// Time between the last robot's connection and the first frame.
const START_DELAY: Duration = Duration::from_millis(100);

/// When robots send.
#[derive(Clone, Copy)]
pub(crate) enum SendMode {
    /// At a fixed rate in frames per second and robot, however late the socket accepts them.
    Scheduled(f64),
    /// At a fixed rate, but a frame is dropped if the socket is still busy when it is due: a robot wants predictions from
    /// new frames.
    ScheduledOrDropped(f64),
    /// Always this many frames ahead of the answers.
    ClosedLoop(usize),
}

/// A load of streaming robots. The warm-up is not measured, so that opening many sockets does not influence the latencies.
#[derive(Clone, Copy)]
pub(crate) struct RobotLoad {
    pub(crate) sessions: usize,
    /// If set, each robot asks for a plan with every prediction: the best of this number of plans.
    pub(crate) plan_samples: Option<usize>,
    pub(crate) mode: SendMode,
    /// What the server does with frames that newer ones have overtaken.
    pub(crate) on_late: OnLate,
    pub(crate) warm_up: Duration,
    pub(crate) measured: Duration,
}

/// Measurements of a load.
pub(crate) struct RobotLoadResult {
    pub(crate) counts: FrameCounts,
    /// Frames that were not sent because the socket was busy.
    pub(crate) not_sent: u64,
    /// Percent of a core.
    pub(crate) server_cpu: f64,
    pub(crate) own_cpu: f64,
    from: Instant,
    to: Instant,
}

impl RobotLoad {
    pub(crate) async fn run(&self, server: &Server, workload: &Arc<Workload>) -> RobotLoadResult {
        let mut http = Http::new(server.address);
        let (mut sessions, mut sockets) = (Vec::new(), Vec::new());
        for _ in 0..self.sessions {
            let session = Session::open(&mut http, workload.model(), self.on_late).await;
            let socket = session::connect(server.address, &session.stream_path()).await;
            let mut socket = socket.expect("the stream opens");
            if let Some(samples) = self.plan_samples {
                session::ask_for_plans(&mut socket, samples).await;
            }
            sockets.push(socket);
            sessions.push(session);
        }
        let begin = Instant::now() + START_DELAY;
        let (from, to) = (begin + self.warm_up, begin + self.warm_up + self.measured);
        let (mut send_times, mut robots) = (Vec::new(), Vec::new());
        for socket in sockets {
            let (send_time, receiver) = mpsc::channel(self.queue_length());
            let answered = self.answered(send_time.clone(), to);
            robots.push(tokio::spawn(robot::run(
                socket,
                Arc::clone(workload),
                receiver,
                answered,
            )));
            send_times.push(send_time);
        }
        let not_sent = self.start(begin, send_times);
        sleep_until(from.into()).await;
        let shares = [&server.process.0, "self"].map(|process| CpuShare::begin(Process(process.to_owned())));
        sleep_until(to.into()).await;
        let [server_cpu, own_cpu] = shares.map(|share| share.percent());
        let mut counts = FrameCounts::default();
        for robot in join_all(robots).await {
            counts.add(robot.unwrap());
        }
        for session in sessions {
            http.expect(204, &session.deletion()).await;
        }
        RobotLoadResult {
            counts,
            not_sent: not_sent.load(Ordering::Relaxed),
            server_cpu,
            own_cpu,
            from,
            to,
        }
    }

    fn queue_length(&self) -> usize {
        match self.mode {
            SendMode::Scheduled(rate_hz) => {
                1 + (rate_hz * (self.warm_up + self.measured).as_secs_f64()).ceil() as usize
            }
            SendMode::ScheduledOrDropped(_) => 1,
            SendMode::ClosedLoop(ahead) => ahead,
        }
    }

    /// Called after each answer. In a closed loop it sends the next frame.
    fn answered(&self, send_time: mpsc::Sender<Instant>, to: Instant) -> impl FnMut() + Send + use<> {
        let mut send_time = matches!(self.mode, SendMode::ClosedLoop(_)).then_some(send_time);
        move || {
            let now = Instant::now();
            send_time = send_time.take().filter(|_| now < to);
            if let Some(send_time) = &send_time {
                // The channel is full only if the socket is busy; then enough frames are waiting.
                let _ = send_time.try_send(now);
            }
        }
    }

    /// Starts sending, one robot after the other, and counts the frames that are not sent.
    fn start(&self, begin: Instant, send_times: Vec<mpsc::Sender<Instant>>) -> Arc<AtomicU64> {
        let not_sent = Arc::new(AtomicU64::new(0));
        match self.mode {
            SendMode::ClosedLoop(ahead) => {
                for send_time in send_times
                    .iter()
                    .flat_map(|send_time| std::iter::repeat_n(send_time, ahead))
                {
                    send_time
                        .try_send(begin)
                        .expect("the channel has room for the first frames");
                }
            }
            SendMode::Scheduled(rate_hz) | SendMode::ScheduledOrDropped(rate_hz) => {
                let schedule =
                    Schedule::lasting(begin, rate_hz * send_times.len() as f64, self.warm_up + self.measured);
                let count = Arc::clone(&not_sent);
                schedule.start(move |tick| {
                    let send_time = &send_times[tick.index as usize % send_times.len()];
                    if send_time.try_send(tick.scheduled).is_err() {
                        count.fetch_add(1, Ordering::Relaxed);
                    }
                });
            }
        }
        not_sent
    }
}

impl RobotLoadResult {
    /// Latencies of the predictions whose frames were scheduled in the measured time.
    pub(crate) fn latencies(&self, of: impl Fn(&PredictionTimes) -> Duration) -> Latencies {
        self.measured(&self.counts.answers, of)
    }

    /// Latencies of the plans from the schedule of their frames, in the measured time.
    pub(crate) fn plans_since_schedule(&self) -> Latencies {
        self.measured(&self.counts.plans, |plan| plan.received - plan.scheduled)
    }

    fn measured(&self, times: &[PredictionTimes], of: impl Fn(&PredictionTimes) -> Duration) -> Latencies {
        let counted = times.iter();
        Latencies::of(
            counted
                .filter(|time| (self.from..self.to).contains(&time.scheduled))
                .map(of),
        )
    }

    pub(crate) fn since_schedule(&self) -> Latencies {
        self.latencies(|answer| answer.received - answer.scheduled)
    }

    /// Microseconds of the server's processor time per prediction in the measured time.
    pub(crate) fn each_us(&self) -> f64 {
        1e4 * self.server_cpu / self.goodput_hz()
    }

    /// Predictions per second received in the measured time.
    pub(crate) fn goodput_hz(&self) -> f64 {
        let received = |answer: &&PredictionTimes| (self.from..self.to).contains(&answer.received);
        self.counts.answers.iter().filter(received).count() as f64 / (self.to - self.from).as_secs_f64()
    }
}
