//! Persistent state: rows in a database ([`jobs`] with their [`reports`], [`models`], [`keys`], [`audit`]) and files in
//! [`objects`]. [`backup`] copies both.
//! Only `database` knows that there are two kinds of database; `sqlite` opens the embedded one. SQL is only in this module.

pub mod audit;
pub mod backup;
mod database;
mod job_id;
mod job_rows;
pub mod jobs;
pub mod keys;
mod lease;
pub mod models;
pub mod objects;
mod parts;
pub mod reports;
mod restore;
mod sqlite;
mod wal;

use std::error::Error as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio::sync::Mutex;
use tracing::warn;

pub use self::audit::Author;
use self::database::Database;
pub use self::job_id::{JobId, JobIdError};
pub use self::job_rows::{EnqueueResult, JobCount, JobOutcome, JobPage, JobRow, NewJob};
pub use self::keys::{KeyRow, KeyScope};
pub use self::lease::Lease;
pub use self::models::{ModelMetrics, PublishedVersion};
pub use self::objects::Objects;
pub use self::parts::PartCounts;
pub use self::reports::{JobReport, LogRow, LossRow};
pub use self::restore::restore;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::{is_transient, write_atomically};

/// The embedded database's file in the data directory.
const DATABASE_FILE: &str = "foreframe.db";
/// The time limit of a write check.
const WRITE_CHECK_LIMIT: Duration = Duration::from_secs(2);
/// How long a successful write check is valid.
const WRITE_CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// The file that a write check writes.
const WRITE_PROBE: &str = "write-check";
/// Its size: more than what is left in blocks that a full file system has already given out.
const PROBE_BYTES: usize = 16 << 10;
/// The pause between two attempts to open the database.
const OPEN_AGAIN_AFTER: Duration = Duration::from_secs(1);
/// The maximum number of connections to the database.
const MAX_CONNECTIONS: u32 = 8;
/// How long a statement waits for a connection or, on SQLite, for another writer.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);
/// The file in the data directory that says that API keys were created.
const KEYS_MARKER: &str = "api-keys-created";

/// Why the store could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// A URL with an unknown scheme. The error shows only the scheme, because the rest can hold a password.
    #[error("{flag} starts with \"{scheme}\"; use {expected}")]
    Url {
        /// `database` or `objects`.
        flag: &'static str,
        /// The scheme, up to the colon.
        scheme: String,
        /// The supported forms.
        expected: &'static str,
    },
    /// The database could not be reached or opened.
    #[error("could not open the {database} database: {source}")]
    Open {
        /// `SQLite` or `PostgreSQL`.
        database: &'static str,
        /// The database's error.
        source: sqlx::Error,
    },
    /// The URL asks for TLS, but the program was built without it.
    #[error(
        "the sslmode in database_url needs TLS, but this program was built without it; build it with --features cloud"
    )]
    NoTls,
    /// The database file is damaged.
    #[error("the database {} is damaged ({reason}); restore it from a backup", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What SQLite found.
        reason: String,
    },
    /// PostgreSQL could not be reached for a while.
    #[error("gave up after waiting {waited_s} s for the database (database_wait_s): {source}")]
    Away {
        /// How long, in seconds.
        waited_s: u64,
        /// The last error.
        source: Box<StoreError>,
    },
    /// `foreframe restore` did not finish.
    #[error("the restore into {} did not finish; run foreframe restore again", .0.display())]
    Restoring(PathBuf),
    /// The tables could not be migrated to this version of the program.
    #[error("could not migrate the database's tables to this version: {0}")]
    Migrate(#[source] sqlx::migrate::MigrateError),
    /// A statement failed.
    #[error("the database failed: {0}")]
    Query(#[from] sqlx::Error),
    /// A file of the store could not be read or written.
    #[error("could not {action} {}: {source}", path.display())]
    Io {
        /// `read`, `write`, …
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// An object could not be read or written.
    #[error("could not {action} the object {key}: {source}")]
    Object {
        /// `read`, `write`, …
        action: &'static str,
        /// Its key.
        key: String,
        /// The object store's reason.
        source: object_store::Error,
    },
}

impl HasErrorKind for StoreError {
    fn kind(&self) -> ErrorKind {
        if self.is_unavailable() {
            return ErrorKind::Away;
        }
        match self {
            Self::Url { .. } | Self::NoTls => ErrorKind::Usage,
            Self::Damaged { .. } | Self::Restoring(_) => ErrorKind::Unusable,
            _ => ErrorKind::Internal,
        }
    }
}

impl StoreError {
    /// Whether the store cannot be reached or written now, for example because the disk is full, but may be later.
    #[must_use]
    pub fn is_unavailable(&self) -> bool {
        match self {
            Self::Query(error) | Self::Open { source: error, .. } => database::is_unavailable(error),
            Self::Io { source, .. } => is_transient(source),
            Self::Object { source, .. } => matches!(source, object_store::Error::Generic { .. }),
            Self::Away { .. } => true,
            Self::Migrate(error) => {
                let cause = error.source().and_then(|cause| cause.downcast_ref::<sqlx::Error>());
                cause.is_some_and(database::is_unavailable)
            }
            Self::Url { .. } | Self::NoTls | Self::Damaged { .. } | Self::Restoring(_) => false,
        }
    }

    fn url(flag: &'static str, url: &str, expected: &'static str) -> Self {
        let scheme = url.split(':').next().unwrap_or_default().chars().take(16).collect();
        Self::Url { flag, scheme, expected }
    }

    fn open(database: &'static str, source: sqlx::Error) -> Self {
        match source {
            sqlx::Error::Tls(_) if !cfg!(feature = "cloud") => Self::NoTls,
            source => Self::Open { database, source },
        }
    }

    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

/// Where state is kept.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StoreConfig {
    /// The data directory. It holds the database file and the objects, unless they are configured elsewhere.
    pub data_dir: PathBuf,
    /// `sqlite:FILE` or `postgres://…`; a file in the data directory by default.
    pub database: Option<String>,
    /// A directory or `s3://BUCKET/PREFIX`; the data directory by default.
    pub objects: Option<String>,
}

impl StoreConfig {
    /// Whether the database is another process, which can be away for a while.
    fn is_remote(&self) -> bool {
        self.database.as_ref().is_some_and(|url| url.starts_with("postgres"))
    }

    /// The file of SQLite's database; `None` with another database. Errors: `Open`.
    fn database_file(&self) -> Result<Option<PathBuf>, StoreError> {
        match &self.database {
            None => Ok(Some(self.data_dir.join(DATABASE_FILE))),
            Some(url) => sqlite::file_of(url),
        }
    }

    /// Whether there is a store to open: one in the data directory, or one that is named.
    #[must_use]
    pub fn exists(&self) -> bool {
        self.database.is_some() || self.data_dir.join(DATABASE_FILE).is_file()
    }
}

/// The open store. Clones share its connections.
#[derive(Clone)]
pub struct Store {
    database: Database,
    objects: Objects,
    /// When the database was written last by a check.
    last_write_check: Arc<Mutex<Option<Instant>>>,
}

impl Store {
    /// Opens the store, creates what is missing, and migrates the tables. Needs a tokio runtime, now and later.
    /// Errors: `Url`, `NoTls`, `Open`, `Damaged`, `Restoring`, `Migrate`, `Io`, `Object`.
    pub async fn open(config: &StoreConfig) -> Result<Self, StoreError> {
        Self::open_with(config, true).await
    }

    /// Opens a store that this program has opened before, without the check of its integrity. Errors: as [`Store::open`].
    pub async fn open_existing(config: &StoreConfig) -> Result<Self, StoreError> {
        Self::open_with(config, false).await
    }

    /// Opens the store as [`Store::open`]. While its PostgreSQL cannot be reached, tries again for `limit`.
    /// Errors: as [`Store::open`], and `Away`.
    pub async fn open_waiting(config: &StoreConfig, limit: Duration) -> Result<Self, StoreError> {
        let started = Instant::now();
        loop {
            let error = match Self::open(config).await {
                Err(error @ StoreError::Open { .. }) if config.is_remote() && error.is_unavailable() => error,
                opened => return opened,
            };
            let waited_s = started.elapsed().as_secs();
            if started.elapsed() >= limit {
                let source = Box::new(error);
                return Err(StoreError::Away { waited_s, source });
            }
            warn!(%error, waited_s, limit_s = limit.as_secs(), "waiting for the database");
            tokio::time::sleep(OPEN_AGAIN_AFTER.min(limit)).await;
        }
    }

    async fn open_with(config: &StoreConfig, is_first: bool) -> Result<Self, StoreError> {
        let data_dir = &config.data_dir;
        std::fs::create_dir_all(data_dir).map_err(StoreError::io("make", data_dir))?;
        if data_dir.join(backup::RESTORING).exists() {
            return Err(StoreError::Restoring(data_dir.clone()));
        }
        let database = Database::open(config, is_first).await?;
        Ok(Self {
            database,
            objects: Objects::open(data_dir, config.objects.as_deref())?,
            last_write_check: Arc::default(),
        })
    }

    /// Checks that the database and the data directory can be written, by a write at most once a second. Errors: `Query`, `Io`.
    pub async fn check_writable(&self) -> Result<(), StoreError> {
        let mut last = self.last_write_check.lock().await;
        if last.is_some_and(|last| last.elapsed() < WRITE_CHECK_INTERVAL) {
            return Ok(());
        }
        let checked = tokio::time::timeout(WRITE_CHECK_LIMIT, self.write_nothing()).await;
        checked.unwrap_or(Err(StoreError::Query(sqlx::Error::PoolTimedOut)))?;
        *last = Some(Instant::now());
        Ok(())
    }

    async fn write_nothing(&self) -> Result<(), StoreError> {
        objects::write(&self.objects.data_dir().join(WRITE_PROBE), vec![0; PROBE_BYTES]).await?;
        let mut tx = self.database.begin().await?;
        tx.lock_numbers().await?;
        tx.commit().await
    }

    /// Closes all connections. With SQLite, `foreframe.db` alone is then complete. Errors: `Query`.
    pub async fn close(&self) -> Result<(), StoreError> {
        self.database.close().await
    }

    /// Whether API keys were ever created for this data directory. A marker file outside the database says so, so that a lost
    /// or replaced database does not switch authentication off.
    #[must_use]
    pub fn keys_were_created(&self) -> bool {
        self.keys_marker().exists()
    }

    fn keys_marker(&self) -> PathBuf {
        self.objects.data_dir().join(KEYS_MARKER)
    }

    /// Writes the marker. Errors: `Io`.
    fn mark_keys_created(&self) -> Result<(), StoreError> {
        let marker = self.keys_marker();
        if marker.exists() {
            return Ok(());
        }
        let text = "API keys were created, so requests need one. To switch authentication off, delete this file and all keys.\n";
        write_atomically(&marker, text.as_bytes()).map_err(StoreError::io("write", &marker))
    }

    /// The files.
    #[must_use]
    pub fn objects(&self) -> &Objects {
        &self.objects
    }

    /// The database's time in seconds since 1970. Leases, the expiry of keys and the order in which jobs ended go by this
    /// clock, since the clocks of several machines can differ. Errors: `Query`.
    pub async fn now_s(&self) -> Result<f64, StoreError> {
        self.database.now_s().await
    }

    /// Checks that the database answers. Errors: `Query`.
    pub async fn ping(&self) -> Result<(), StoreError> {
        self.now_s().await.map(drop)
    }
}

/// The time of this machine's clock in the store's unit, seconds since 1970: only for times that are shown. Decisions go by
/// [`Store::now_s`].
#[must_use]
pub fn unix_s() -> f64 {
    let since_1970 = std::time::SystemTime::now().duration_since(std::time::SystemTime::UNIX_EPOCH);
    since_1970.unwrap_or_default().as_secs_f64()
}
