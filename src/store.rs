//! Where state lives that outlasts the process: rows in a database ([`jobs`] with their [`accounts`], [`models`], [`keys`]),
//! whole files in [`objects`]. `database` alone knows that there are two kinds of database; SQL is written nowhere but here.

pub mod accounts;
mod database;
pub mod jobs;
pub mod keys;
pub mod models;
pub mod objects;

use std::path::{Path, PathBuf};

pub use self::accounts::{JobUpdate, LogRow, LossRow};
use self::database::Database;
pub use self::jobs::{EnqueueResult, JobOutcome, JobPage, JobRow, Lease, NewJob};
pub use self::keys::KeyRow;
pub use self::models::VersionRow;
pub use self::objects::Objects;

/// The embedded database's file in the data directory.
const DATABASE_FILE: &str = "foreframe.db";

/// Why state could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// A URL of a kind that is not known. It is told without what may be secret in it.
    #[error("{flag} starts with \"{scheme}\"; use {known}")]
    Url {
        /// `database` or `objects`.
        flag: &'static str,
        /// What it starts with, up to the colon.
        scheme: String,
        /// What it may be.
        known: &'static str,
    },
    /// The database could not be reached or opened.
    #[error("could not open the {database} database: {source}")]
    Open {
        /// `SQLite` or `PostgreSQL`.
        database: &'static str,
        /// Its reason.
        source: sqlx::Error,
    },
    /// TLS is asked for and cannot be had.
    #[error(
        "database_url asks for TLS by its sslmode, which this program was built without; build it with --features cloud"
    )]
    NoTls,
    /// The tables could not be brought to this program's form.
    #[error("could not bring the database's tables to this version: {0}")]
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

impl StoreError {
    fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

/// Where state is kept.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StoreConfig {
    /// The directory that holds the database's file and the objects, unless they are elsewhere.
    pub data_dir: PathBuf,
    /// `sqlite:FILE` or `postgres://…`; a file in the data directory where it is not given.
    pub database: Option<String>,
    /// A directory or `s3://BUCKET/PREFIX`; the data directory where it is not given.
    pub objects: Option<String>,
}

/// The open store; clones share its connections.
#[derive(Clone)]
pub struct Store {
    database: Database,
    objects: Objects,
}

impl Store {
    /// Opens it, makes what is not there yet, and brings the tables to this program's form. Must be called, and the store
    /// used, within a tokio runtime. Errors: `Url`, `NoTls`, `Open`, `Migrate`, `Io`, `Object`.
    pub async fn open(config: &StoreConfig) -> Result<Self, StoreError> {
        let data_dir = &config.data_dir;
        std::fs::create_dir_all(data_dir).map_err(StoreError::io("make", data_dir))?;
        let database = match &config.database {
            Some(url) => Database::open(url).await?,
            None => Database::open_file(&data_dir.join(DATABASE_FILE)).await?,
        };
        Ok(Self {
            database,
            objects: Objects::open(data_dir, config.objects.as_deref())?,
        })
    }

    /// The files.
    #[must_use]
    pub fn objects(&self) -> &Objects {
        &self.objects
    }

    /// Answers when the database does. Errors: `Query`.
    pub async fn ping(&self) -> Result<(), StoreError> {
        self.database.fetch("SELECT 1", vec![]).await.map(drop)
    }
}

/// The time as the store keeps it: seconds since 1970.
#[must_use]
pub fn unix_s() -> f64 {
    let since_1970 = std::time::SystemTime::now().duration_since(std::time::SystemTime::UNIX_EPOCH);
    since_1970.unwrap_or_default().as_secs_f64()
}
