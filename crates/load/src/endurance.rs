//! Everything at once: robots, requests, jobs, pictures, hostile clients, kills, a full disk and a database that is away.
//! At the end, nothing that was acknowledged is lost, and every prediction was right.

mod changes;
mod hostile;
mod outages;
mod recording;
mod requests;
mod robot;
mod shared;
mod summary;
mod supervisor;
mod verify;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use foreframe_core::registry::{self, Model};
use futures_util::future::join_all;
use tokio::task::JoinHandle;
use tokio::time::{sleep, sleep_until, timeout};

use self::hostile::HostileCounts;
use self::outages::{DatabaseOutage, Outage, OutageReport, SmallDisk};
use self::recording::RobotRecording;
use self::robot::{EnduranceRobot, RobotReport};
use self::shared::EnduranceRun;
use self::supervisor::Supervisor;
use self::verify::EndedJobs;
use crate::health::post;
use crate::http::{Http, Request};
use crate::project;
use crate::report::Bounds;
use crate::workload::Workload;

/// How long the clients may take to notice the end.
const END_LIMIT: Duration = Duration::from_mins(5);
/// How long the base data set may take to be collected.
const SET_UP_LIMIT: Duration = Duration::from_mins(10);
const SET_UP_POLL: Duration = Duration::from_millis(200);
/// At least this many kills.
const MIN_KILLS: u32 = 2;
/// Clients that ask for pictures.
const PICTURE_CLIENTS: u64 = 2;
/// After this share of the time between two kills, an outage begins.
const OUTAGE_SHARE: f64 = 0.3;

#[derive(clap::Args)]
pub(crate) struct EnduranceArgs {
    /// Minutes of load. The checks afterwards take about another minute
    #[arg(long, default_value_t = 5.0)]
    minutes: f64,
    /// Seconds at the beginning without the hostile part, to compare latencies with
    #[arg(long, default_value_t = 30.0)]
    calm_s: f64,
    /// Number of robots
    #[arg(long, default_value_t = 20)]
    robots: u64,
    /// Frames per second of each robot
    #[arg(long, default_value_t = 30.0)]
    rate_hz: f64,
    /// Minutes between kills of the server; at least two kills are made
    #[arg(long, default_value_t = 3.0)]
    kill_minutes: f64,
    /// Seconds of each outage
    #[arg(long, default_value_t = 20.0)]
    outage_s: f64,
    /// The robots' model
    #[arg(long, default_value = "moving")]
    model: String,
    /// An empty PostgreSQL database instead of SQLite; a proxy before it makes the outage
    #[arg(long, value_name = "URL")]
    database_url: Option<String>,
    /// Bound: median latency of the robots' predictions from new frames beside everything else
    #[arg(long, default_value_t = 5000.0)]
    p50_ms: f64,
}

/// What happened to the server.
#[derive(Default)]
struct Incidents {
    /// Times from each kill until the server was ready again.
    restarts: Vec<Duration>,
    outages: Vec<OutageReport>,
    /// Whether the server ended when it was not killed.
    has_crashed: bool,
}

pub(crate) async fn run(args: &EnduranceArgs, bounds: &mut Bounds) {
    let scratch = tempfile::tempdir().unwrap();
    let data_dir = scratch.path().join("data");
    std::fs::create_dir(&data_dir).unwrap();
    let disk = SmallDisk::mount(&data_dir).map(Outage::Disk);
    if disk.is_none() {
        println!("the full disk is left out: this process cannot mount a file system");
    }
    let (database, store_arguments) = database(args, &data_dir).await;
    let outages: Vec<Outage> = disk.into_iter().chain([Outage::Database(database)]).collect();
    let mut supervisor = Supervisor::start(&data_dir, &store_arguments, &scratch.path().join("log")).await;
    let run = Arc::new(set_up(args, &supervisor).await);
    let models = project::root().join("models");
    let model = registry::load(&models.join(&args.model)).expect("the model is shipped");
    let load = Load::start(args, &run, &model);
    sleep_until(load.attack.into()).await;
    println!("the hostile part begins");
    let counts = Arc::new(HostileCounts::default());
    let hostile = hostile::start(&run, &model, &counts);
    let mut incidents = incidents(args, &run, &mut supervisor, load.attack, &outages).await;
    sleep_until(run.end().into()).await;
    drop(hostile);
    let results = load.end(&run).await;
    let jobs = EndedJobs::wait(&run, bounds).await;
    incidents.has_crashed |= !supervisor.is_running();
    let is_clean_stop = supervisor.stop().await;
    bounds.check(is_clean_stop, "the server stops cleanly at SIGTERM");
    supervisor.spawn().await;
    verify::versions(&run, &jobs, bounds).await;
    verify::datasets(&run, &jobs, bounds).await;
    verify::keys(&run, bounds).await;
    summary::print(args, &run, &results, &incidents, &counts);
    summary::check(args, &run, &results, &incidents, bounds);
    let log = supervisor.log();
    let panics = log.lines().filter(|line| line.contains("panicked")).count();
    bounds.check(panics == 0, format!("the server's log has no panic ({panics} found)"));
}

/// The outage of the database, and the server's arguments for it.
async fn database(args: &EnduranceArgs, data_dir: &Path) -> (DatabaseOutage, Vec<String>) {
    let Some(url) = &args.database_url else {
        return (DatabaseOutage::Lock(data_dir.join("foreframe.db")), Vec::new());
    };
    let (head, rest) = url
        .split_once('@')
        .expect("the URL has the form postgres://USER@HOST:PORT/NAME");
    let (host, name) = rest.split_once('/').expect("the URL names a database");
    let address = host.parse().expect("the URL has an IP address and a port");
    let (proxy, mode) = outages::proxy(address).await;
    let arguments = vec!["--database-url".to_owned(), format!("{head}@{proxy}/{name}")];
    (DatabaseOutage::Proxy(mode), arguments)
}

/// Collects the base data set and creates keys.
async fn set_up(args: &EnduranceArgs, supervisor: &Supervisor) -> EnduranceRun {
    let mut http = Http::new(supervisor.address);
    let job = post(&mut http, &changes::base()).await;
    let since = Instant::now();
    while http.expect(200, &Request::get(&job)).await.json()["state"] != "succeeded" {
        assert!(
            since.elapsed() < SET_UP_LIMIT,
            "the base data set is not collected in time"
        );
        sleep(SET_UP_POLL).await;
    }
    let mut run = EnduranceRun::new(supervisor, Workload::of(&args.model));
    for (scope, key) in [("admin", true), ("predict", false)] {
        let created = changes::command(&run, &["keys", "create", "load", "--scope", scope]).await;
        let text = created.expect("keys can be created");
        *if key { &mut run.admin_key } else { &mut run.robot_key } = text;
    }
    run
}

/// The ordinary load.
struct Load {
    robots: Vec<JoinHandle<RobotReport>>,
    predictions: JoinHandle<Vec<(Instant, Duration)>>,
    others: Vec<JoinHandle<()>>,
    /// When the hostile part begins.
    attack: Instant,
}

/// What the ordinary load measured.
struct LoadResults {
    robots: Vec<RobotReport>,
    /// When predictions over HTTP were sent, and how long they took.
    predictions: Vec<(Instant, Duration)>,
    attack: Instant,
}

impl Load {
    fn start(args: &EnduranceArgs, run: &Arc<EnduranceRun>, model: &Model) -> Self {
        let recordings: Vec<RobotRecording> = (0..args.robots)
            .map(|robot| RobotRecording::new(robot, &run.workload, model))
            .collect();
        let expected = Arc::new(requests::expected(&run.workload, model));
        let begin = Instant::now();
        run.end_at(begin + Duration::from_secs_f64(60.0 * args.minutes));
        let robots = recordings.into_iter().enumerate().map(|(index, recording)| {
            // They do not all send at the same moment.
            let offset = Duration::from_secs_f64(index as f64 / args.robots as f64 / args.rate_hz);
            let robot = EnduranceRobot::new(Arc::clone(run), recording, begin + offset, args.rate_hz);
            tokio::spawn(robot.run())
        });
        let mut others = vec![
            tokio::spawn(requests::rollouts(Arc::clone(run), Arc::clone(&expected))),
            tokio::spawn(changes::jobs(Arc::clone(run))),
            tokio::spawn(changes::versions(Arc::clone(run))),
            tokio::spawn(changes::datasets(Arc::clone(run))),
            tokio::spawn(changes::keys(Arc::clone(run))),
        ];
        others.extend((0..PICTURE_CLIENTS).map(|client| tokio::spawn(requests::pictures(Arc::clone(run), client))));
        Self {
            robots: robots.collect(),
            predictions: tokio::spawn(requests::predictions(Arc::clone(run), expected)),
            others,
            attack: begin + Duration::from_secs_f64(args.calm_s),
        }
    }

    /// Waits until all clients have ended.
    async fn end(self, run: &EnduranceRun) -> LoadResults {
        let all = async {
            let robots = join_all(self.robots).await;
            join_all(self.others).await.into_iter().for_each(Result::unwrap);
            (robots, self.predictions.await.unwrap())
        };
        let (robots, predictions) = timeout(END_LIMIT, all)
            .await
            .unwrap_or_else(|_| panic!("a client waits without end; faults: {:?}", run.faults()));
        LoadResults {
            robots: robots.into_iter().map(Result::unwrap).collect(),
            predictions,
            attack: self.attack,
        }
    }
}

/// Kills the server at equal intervals. Before each kill there is an outage; after the last kill there is none.
async fn incidents(
    args: &EnduranceArgs,
    run: &Arc<EnduranceRun>,
    supervisor: &mut Supervisor,
    attack: Instant,
    outages: &[Outage],
) -> Incidents {
    let time = run.end().saturating_duration_since(attack);
    let kills = MIN_KILLS.max((time.as_secs_f64() / 60.0 / args.kill_minutes) as u32);
    let (interval, mut incidents) = (time / (kills + 1), Incidents::default());
    for kill in 0..kills {
        let began = attack + interval * kill;
        sleep_until((began + interval.mul_f64(OUTAGE_SHARE)).into()).await;
        let outage = &outages[kill as usize % outages.len()];
        println!("{}", outage.name());
        incidents
            .outages
            .push(outage.hold(run, Duration::from_secs_f64(args.outage_s)).await);
        sleep_until((began + interval).into()).await;
        println!("kill -9");
        let killed = Instant::now();
        run.availability.change();
        incidents.has_crashed |= !supervisor.kill();
        supervisor.spawn().await;
        run.availability.change();
        incidents.restarts.push(killed.elapsed());
    }
    incidents
}
