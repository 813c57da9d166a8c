//! A disk that is full and a database that is away, each for a while.

use std::fs::{self, File};
use std::io::Write as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rusqlite::Connection;
use tokio::io::copy_bidirectional;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::time::sleep;

use super::shared::EnduranceRun;
use crate::http::{Http, Request};

/// Size of the mounted disk.
const DISK_SIZE: &str = "4g";
/// What is left on the disk before the filler takes it.
const LEFT_BYTES: u64 = 256 << 10;
/// The filler takes again what others freed.
const FILL_PERIOD: Duration = Duration::from_millis(100);
/// How often the metrics are asked for.
const POLL: Duration = Duration::from_millis(250);
/// How long the server may take to write its store after an outage.
const RECOVERY_LIMIT: Duration = Duration::from_mins(2);
/// How long the database's lock is waited for.
const LOCK_LIMIT: Duration = Duration::from_secs(30);

/// A mounted file system that can be made full. Dropping it unmounts it.
pub(super) struct SmallDisk(PathBuf);

impl SmallDisk {
    /// `None` if this process cannot mount one.
    pub(super) fn mount(dir: &Path) -> Option<Self> {
        let options = format!("size={DISK_SIZE}");
        let mut command = Command::new("mount");
        command.args(["-t", "tmpfs", "-o", &options, "foreframe-load"]).arg(dir);
        mounted_by(&mut command).then(|| Self(dir.to_owned()))
    }

    fn resize(&self, size: &str) -> bool {
        mounted_by(
            Command::new("mount")
                .args(["-o", &format!("remount,size={size}")])
                .arg(&self.0),
        )
    }

    /// Fills the disk for a while. It is made small first, so that filling it takes no memory.
    async fn fill(&self, time: Duration) {
        let filler = self.0.join("filler");
        let since = Instant::now();
        // The size is refused if more was written meanwhile.
        while !self.resize(&(used_bytes(&self.0) + LEFT_BYTES).to_string()) {
            sleep(FILL_PERIOD).await;
        }
        while since.elapsed() < time {
            let mut file = File::options().append(true).create(true).open(&filler);
            while file.as_mut().is_ok_and(|file| file.write_all(&[0; 4096]).is_ok()) {}
            sleep(FILL_PERIOD).await;
        }
        // It is missing if others took all that was left.
        let _ = fs::remove_file(filler);
        assert!(self.resize(DISK_SIZE), "the disk can be made large again");
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

fn mounted_by(command: &mut Command) -> bool {
    command.output().is_ok_and(|output| output.status.success())
}

fn used_bytes(dir: &Path) -> u64 {
    let output = Command::new("df")
        .args(["-B1", "--output=used"])
        .arg(dir)
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines()
        .nth(1)
        .and_then(|used| used.trim().parse().ok())
        .expect("df prints a number")
}

/// How the database is taken away.
pub(super) enum DatabaseOutage {
    /// Another process holds SQLite's write lock.
    Lock(PathBuf),
    /// A proxy before PostgreSQL ends all connections and refuses new ones, and later accepts them without an answer.
    Proxy(watch::Sender<ProxyMode>),
}

/// What the proxy before the database does.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum ProxyMode {
    Pass,
    Refuse,
    Hold,
}

impl DatabaseOutage {
    async fn hold(&self, time: Duration) {
        match self {
            Self::Lock(path) => {
                let path = path.clone();
                let locked = tokio::task::spawn_blocking(move || {
                    let database = Connection::open(path).unwrap();
                    database.busy_timeout(LOCK_LIMIT).unwrap();
                    database.execute_batch("BEGIN EXCLUSIVE").unwrap();
                    std::thread::sleep(time);
                    database.execute_batch("ROLLBACK").unwrap();
                });
                locked.await.unwrap();
            }
            Self::Proxy(mode) => {
                for part in [ProxyMode::Refuse, ProxyMode::Hold] {
                    mode.send_replace(part);
                    sleep(time / 2).await;
                }
                mode.send_replace(ProxyMode::Pass);
            }
        }
    }
}

/// Starts a proxy on a free port before a database. Returns its address.
pub(super) async fn proxy(database: SocketAddr) -> (SocketAddr, watch::Sender<ProxyMode>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, mode) = watch::channel(ProxyMode::Pass);
    tokio::spawn(async move {
        while let Ok((client, _)) = listener.accept().await {
            tokio::spawn(pass(client, database, mode.clone()));
        }
    });
    (address, sender)
}

/// Passes the bytes of a connection on until the mode changes.
async fn pass(mut client: TcpStream, database: SocketAddr, mut mode: watch::Receiver<ProxyMode>) {
    let now = *mode.borrow_and_update();
    if now == ProxyMode::Refuse {
        return;
    }
    let passed = async {
        if now == ProxyMode::Hold {
            return std::future::pending().await;
        }
        let mut server = TcpStream::connect(database).await?;
        copy_bidirectional(&mut client, &mut server).await
    };
    tokio::select! {
        _ = passed => {}
        _ = mode.changed() => {}
    }
}

/// What goes away.
pub(super) enum Outage {
    Disk(SmallDisk),
    Database(DatabaseOutage),
}

/// When the metric changed that says whether the store can be written, counted from the start and from the end of an outage; `None`: it
/// did not.
pub(super) struct OutageReport {
    pub(super) name: &'static str,
    pub(super) noticed: Option<Duration>,
    pub(super) recovered: Option<Duration>,
}

impl Outage {
    pub(super) fn name(&self) -> &'static str {
        match self {
            Self::Disk(_) => "full disk",
            Self::Database(_) => "database away",
        }
    }

    /// Takes it away for a while, and watches the server's metrics until the store can be written again.
    pub(super) async fn hold(&self, run: &Arc<EnduranceRun>, time: Duration) -> OutageReport {
        let (began, end) = (Instant::now(), watch::Sender::new(None::<Instant>));
        let watching = tokio::spawn(watch_store(Arc::clone(run), began, end.subscribe()));
        match self {
            Self::Disk(disk) => disk.fill(time).await,
            Self::Database(database) => database.hold(time).await,
        }
        end.send_replace(Some(Instant::now()));
        let (noticed, recovered) = watching.await.unwrap();
        OutageReport {
            name: self.name(),
            noticed,
            recovered,
        }
    }
}

async fn watch_store(
    run: Arc<EnduranceRun>,
    began: Instant,
    end: watch::Receiver<Option<Instant>>,
) -> (Option<Duration>, Option<Duration>) {
    let (mut http, mut noticed) = (Http::new(run.address), None);
    loop {
        let answer = http.ask(&Request::get("/metrics")).await;
        let is_writable = answer.is_ok_and(|answer| answer.text().contains("\nforeframe_store_writable 1\n"));
        if !is_writable {
            noticed.get_or_insert_with(|| began.elapsed());
        }
        let ended = *end.borrow();
        if let Some(ended) = ended {
            if is_writable {
                return (noticed, Some(ended.elapsed()));
            }
            if ended.elapsed() > RECOVERY_LIMIT {
                return (noticed, None);
            }
        }
        sleep(POLL).await;
    }
}
