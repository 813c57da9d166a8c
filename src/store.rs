//! Persistent state: rows in a database ([`jobs`] with their [`reports`], [`models`], [`keys`]) and files in [`objects`].
//! Only `database` knows that there are two kinds of database. SQL is only in this module.

mod database;
pub mod jobs;
pub mod keys;
pub mod models;
pub mod objects;
pub mod reports;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use self::database::Database;
pub use self::jobs::{EnqueueResult, JobOutcome, JobPage, JobRow, Lease, NewJob};
pub use self::keys::KeyRow;
pub use self::models::{ModelMetrics, VersionRow};
pub use self::objects::Objects;
pub use self::reports::{JobReport, LogRow, LossRow};

/// The embedded database's file in the data directory.
const DATABASE_FILE: &str = "foreframe.db";

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

impl StoreError {
    fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self + use<> {
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

/// The open store. Clones share its connections.
#[derive(Clone)]
pub struct Store {
    database: Database,
    objects: Objects,
}

impl Store {
    /// Opens the store, creates what is missing, and migrates the tables. Needs a tokio runtime, now and later.
    /// Errors: `Url`, `NoTls`, `Open`, `Migrate`, `Io`, `Object`.
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

    /// Opens a store that another process of this version has opened before. Errors: as [`Store::open`].
    pub async fn open_existing(config: &StoreConfig) -> Result<Self, StoreError> {
        Self::open(config).await
    }

    /// The files.
    #[must_use]
    pub fn objects(&self) -> &Objects {
        &self.objects
    }

    /// Checks that the database answers. Errors: `Query`.
    pub async fn ping(&self) -> Result<(), StoreError> {
        self.database.fetch("SELECT 1", vec![]).await.map(drop)
    }
}

/// The time in the store's unit: seconds since 1970.
#[must_use]
pub fn unix_s() -> f64 {
    let since_1970 = std::time::SystemTime::now().duration_since(std::time::SystemTime::UNIX_EPOCH);
    since_1970.unwrap_or_default().as_secs_f64()
}
