//! SQLite and PostgreSQL behind one interface: both get the same statements and values. All differences are here.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use futures_util::future::BoxFuture;
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::postgres::{PgConnection, PgPool, PgPoolOptions, PgRow};
use sqlx::query::Query;
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteRow,
};
use sqlx::{
    AssertSqlSafe, Connection as _, Decode, Encode, Postgres, Row as _, SqlSafeStr as _, SqlStr, Sqlite, Transaction,
    Type,
};

use super::job_id::JobId;
use super::{StoreError, wal};
use foreframe_core::files::open_lock;
use foreframe_core::types::ModelName;

/// The maximum number of connections to the database.
const MAX_CONNECTIONS: u32 = 8;
/// How long a statement waits for a connection or, on SQLite, for another writer.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);
/// The time limit of a statement on PostgreSQL. Without it, a server that was paused or disconnected would be waited for
/// without end.
const STATEMENT_LIMIT: Duration = Duration::from_secs(15);

const MIGRATIONS: &[(i64, &str, &str)] = &[
    (1, "initial", include_str!("migrations/0001_initial.sql")),
    (
        2,
        "attempts and metrics",
        include_str!("migrations/0002_attempts_and_metrics.sql"),
    ),
    (
        3,
        "key scopes and audit",
        include_str!("migrations/0003_key_scopes_and_audit.sql"),
    ),
];

/// A parameter of a statement: `$1`, `$2`, …
#[derive(Clone, Debug)]
pub(super) enum DatabaseValue {
    Text(Option<String>),
    Int(Option<i64>),
    Real(Option<f64>),
}

macro_rules! value_from {
    ($variant:ident: $($from:ty => $convert:expr),+) => {
        $(impl From<$from> for DatabaseValue {
            fn from(value: $from) -> Self {
                Self::$variant($convert(value))
            }
        })+
    };
}
value_from!(Text: &str => |text: &str| Some(text.to_owned()), &ModelName => |name: &ModelName| Some(name.to_string()), String => Some, Option<String> => |text| text,
    Option<&str> => |text: Option<&str>| text.map(str::to_owned));
value_from!(Int: i64 => Some, Option<i64> => |int| int, u32 => |int| Some(i64::from(int)),
    JobId => |id: JobId| Some(id.number()));
value_from!(Real: f64 => Some, Option<f64> => |real| real);

/// A row of a result.
pub(super) enum DatabaseRow {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

impl DatabaseRow {
    /// The value in a column. Errors: `Query` if there is no column of that name and type.
    pub(super) fn get<T>(&self, column: &str) -> Result<T, StoreError>
    where
        T: for<'r> Decode<'r, Sqlite> + Type<Sqlite> + for<'r> Decode<'r, Postgres> + Type<Postgres>,
    {
        Ok(match self {
            Self::Sqlite(row) => row.try_get(column)?,
            Self::Postgres(row) => row.try_get(column)?,
        })
    }
}

/// A pool of connections.
#[derive(Clone)]
pub(super) enum Database {
    Sqlite(SqlitePool),
    Postgres(PgPool),
}

/// A transaction. It is rolled back unless committed. On SQLite, only one transaction writes at a time.
pub(super) enum Tx {
    Sqlite(Transaction<'static, Sqlite>),
    Postgres(Transaction<'static, Postgres>),
}

fn bind<'q, DB: sqlx::Database>(sql: SqlStr, values: Vec<DatabaseValue>) -> Query<'q, DB, DB::Arguments>
where
    Option<String>: Encode<'q, DB> + Type<DB>,
    Option<i64>: Encode<'q, DB> + Type<DB>,
    Option<f64>: Encode<'q, DB> + Type<DB>,
{
    values.into_iter().fold(sqlx::query(sql), |query, value| match value {
        DatabaseValue::Text(text) => query.bind(text),
        DatabaseValue::Int(int) => query.bind(int),
        DatabaseValue::Real(real) => query.bind(real),
    })
}

impl Database {
    pub(super) async fn open(url: &str, is_first: bool) -> Result<Self, StoreError> {
        let scheme = url.split(':').next().unwrap_or_default();
        match scheme {
            "sqlite" => {
                let options = SqliteConnectOptions::from_str(url).map_err(|source| StoreError::Open {
                    database: "SQLite",
                    source,
                })?;
                Self::open_sqlite(options, is_first).await
            }
            "postgres" | "postgresql" => Box::pin(Self::open_postgres(url)).await,
            _ => Err(StoreError::Url {
                flag: "database",
                scheme: scheme.chars().take(16).collect(),
                expected: "sqlite:FILE or postgres://USER@HOST/NAME",
            }),
        }
    }

    pub(super) async fn open_file(path: &Path, is_first: bool) -> Result<Self, StoreError> {
        Self::open_sqlite(SqliteConnectOptions::new().filename(path), is_first).await
    }

    /// The file that a URL names; `None` if it does not name SQLite. Errors: `Open`.
    pub(super) fn file_of(url: &str) -> Result<Option<PathBuf>, StoreError> {
        if !url.starts_with("sqlite:") {
            return Ok(None);
        }
        let options = SqliteConnectOptions::from_str(url).map_err(|source| StoreError::Open {
            database: "SQLite",
            source,
        })?;
        Ok(Some(options.get_filename().to_owned()))
    }

    async fn open_sqlite(options: SqliteConnectOptions, is_first: bool) -> Result<Self, StoreError> {
        let path = options.get_filename().to_owned();
        // SQLite's migrations take no lock, and two processes can start at the same time.
        let lock_path = options.get_filename().with_extension("lock");
        let failed = StoreError::io("lock", &lock_path);
        let locked = tokio::task::spawn_blocking(move || {
            let lock = open_lock(&lock_path)?;
            lock.lock().map(|()| lock)
        });
        let _lock = locked.await.unwrap_or_else(|error| Err(error.into())).map_err(failed)?;
        if is_first {
            wal::check(&path)?;
        }
        let options = options
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .busy_timeout(BUSY_TIMEOUT);
        // The pool tries for long and hides the reason; a single connection reports it at once.
        check_connection(&options)
            .await
            .map_err(|source| sqlite_failed(&path, source))?;
        let pool = SqlitePoolOptions::new()
            .max_connections(MAX_CONNECTIONS)
            .acquire_timeout(BUSY_TIMEOUT)
            .after_connect(|connection, _| Box::pin(refuse_read_only(connection)))
            // A failed commit or rollback, for example on a full disk, leaves the connection unusable: discard it.
            .after_release(|connection, _| {
                Box::pin(async move {
                    connection.ping().await?;
                    Ok(!connection.is_in_transaction())
                })
            })
            .connect_with(options)
            .await
            .map_err(|source| sqlite_failed(&path, source))?;
        if is_first {
            check_integrity(&pool, &path).await?;
        }
        migrations().run(&pool).await.map_err(StoreError::Migrate)?;
        Ok(Self::Sqlite(pool))
    }

    /// Writes the present state into a new file, while others read and write. Returns false if this is not possible, because
    /// the database is PostgreSQL.
    pub(super) async fn copy_to(&self, path: &Path) -> Result<bool, StoreError> {
        let Self::Sqlite(pool) = self else { return Ok(false) };
        let path = path.to_string_lossy().into_owned();
        sqlx::query("VACUUM INTO $1").bind(path).execute(pool).await?;
        Ok(true)
    }

    /// The database's time in seconds since 1970, so that the clocks of several machines need not agree.
    pub(super) async fn now_s(&self) -> Result<f64, StoreError> {
        let sql = match self {
            Self::Sqlite(_) => "SELECT (julianday('now') - 2440587.5) * 86400.0 AS now_s",
            Self::Postgres(_) => "SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS DOUBLE PRECISION) AS now_s",
        };
        let rows = self.fetch(sql, vec![]).await?;
        rows.first()
            .ok_or(StoreError::Query(sqlx::Error::RowNotFound))?
            .get("now_s")
    }

    /// Moves everything from the write-ahead log into the database file and closes all connections.
    pub(super) async fn close(&self) -> Result<(), StoreError> {
        let checkpointed = match self {
            Self::Sqlite(_) => self.fetch("PRAGMA wal_checkpoint(TRUNCATE)", vec![]).await.map(drop),
            Self::Postgres(_) => Ok(()),
        };
        match self {
            Self::Sqlite(pool) => pool.close().await,
            Self::Postgres(pool) => pool.close().await,
        }
        checkpointed
    }

    async fn open_postgres(url: &str) -> Result<Self, StoreError> {
        let pool = PgPoolOptions::new()
            .max_connections(MAX_CONNECTIONS)
            .acquire_timeout(BUSY_TIMEOUT)
            .connect(url);
        let pool = match pool.await {
            Ok(pool) => pool,
            // The pool's timeout hides the reason; a single connection reports it.
            Err(sqlx::Error::PoolTimedOut) => {
                let reason = within_limit(PgConnection::connect(url)).await.err();
                return Err(open_failed(reason.unwrap_or(sqlx::Error::PoolTimedOut)));
            }
            Err(error) => return Err(open_failed(error)),
        };
        migrations().run(&pool).await.map_err(StoreError::Migrate)?;
        Ok(Self::Postgres(pool))
    }

    /// The rows of a query.
    pub(super) async fn fetch(
        &self,
        sql: &'static str,
        values: Vec<DatabaseValue>,
    ) -> Result<Vec<DatabaseRow>, StoreError> {
        let sql = sql.into_sql_str();
        Ok(match self {
            Self::Sqlite(pool) => sqlite_rows(bind::<Sqlite>(sql, values).fetch_all(pool).await?),
            Self::Postgres(pool) => postgres_rows(within_limit(bind::<Postgres>(sql, values).fetch_all(pool)).await?),
        })
    }

    /// How many rows a statement changed.
    pub(super) async fn execute(&self, sql: &'static str, values: Vec<DatabaseValue>) -> Result<u64, StoreError> {
        let sql = sql.into_sql_str();
        Ok(match self {
            Self::Sqlite(pool) => bind::<Sqlite>(sql, values).execute(pool).await?.rows_affected(),
            Self::Postgres(pool) => within_limit(bind::<Postgres>(sql, values).execute(pool))
                .await?
                .rows_affected(),
        })
    }

    /// Begins a write transaction.
    pub(super) async fn begin(&self) -> Result<Tx, StoreError> {
        Ok(match self {
            Self::Sqlite(pool) => Tx::Sqlite(pool.begin_with("BEGIN IMMEDIATE").await?),
            Self::Postgres(pool) => Tx::Postgres(within_limit(pool.begin()).await?),
        })
    }
}

impl Tx {
    pub(super) async fn fetch(
        &mut self,
        sql: &'static str,
        values: Vec<DatabaseValue>,
    ) -> Result<Vec<DatabaseRow>, StoreError> {
        self.fetch_any(sql.into_sql_str(), values).await
    }

    /// As `fetch`, but locks the rows and skips those that another transaction has locked.
    pub(super) async fn fetch_free(
        &mut self,
        sql: &'static str,
        values: Vec<DatabaseValue>,
    ) -> Result<Vec<DatabaseRow>, StoreError> {
        let sql = match self {
            Self::Sqlite(_) => sql.into_sql_str(),
            Self::Postgres(_) => AssertSqlSafe(format!("{sql} FOR UPDATE SKIP LOCKED")).into_sql_str(),
        };
        self.fetch_any(sql, values).await
    }

    async fn fetch_any(&mut self, sql: SqlStr, values: Vec<DatabaseValue>) -> Result<Vec<DatabaseRow>, StoreError> {
        Ok(match self {
            Self::Sqlite(tx) => sqlite_rows(bind::<Sqlite>(sql, values).fetch_all(&mut **tx).await?),
            Self::Postgres(tx) => {
                postgres_rows(within_limit(bind::<Postgres>(sql, values).fetch_all(&mut **tx)).await?)
            }
        })
    }

    pub(super) async fn execute(&mut self, sql: &'static str, values: Vec<DatabaseValue>) -> Result<u64, StoreError> {
        let sql = sql.into_sql_str();
        Ok(match self {
            Self::Sqlite(tx) => bind::<Sqlite>(sql, values).execute(&mut **tx).await?.rows_affected(),
            Self::Postgres(tx) => within_limit(bind::<Postgres>(sql, values).execute(&mut **tx))
                .await?
                .rows_affected(),
        })
    }

    pub(super) async fn commit(self) -> Result<(), StoreError> {
        let committed = match self {
            Self::Sqlite(tx) => tx.commit().await,
            Self::Postgres(tx) => within_limit(tx.commit()).await,
        };
        committed.map_err(StoreError::Query)
    }
}

/// Errors: `PoolTimedOut` after the time limit of a statement.
fn within_limit<'a, T: 'a>(
    statement: impl Future<Output = Result<T, sqlx::Error>> + Send + 'a,
) -> BoxFuture<'a, Result<T, sqlx::Error>> {
    // On the heap, since otherwise it would make the future of every caller large.
    Box::pin(async move {
        let done = tokio::time::timeout(STATEMENT_LIMIT, statement).await;
        done.unwrap_or(Err(sqlx::Error::PoolTimedOut))
    })
}

fn sqlite_rows(rows: Vec<SqliteRow>) -> Vec<DatabaseRow> {
    rows.into_iter().map(DatabaseRow::Sqlite).collect()
}

fn postgres_rows(rows: Vec<PgRow>) -> Vec<DatabaseRow> {
    rows.into_iter().map(DatabaseRow::Postgres).collect()
}

fn sqlite_failed(path: &Path, source: sqlx::Error) -> StoreError {
    match sqlite_code(&source) {
        Some(SQLITE_CORRUPT | SQLITE_NOTADB) => StoreError::Damaged {
            path: path.to_owned(),
            reason: source.to_string(),
        },
        _ => StoreError::Open {
            database: "SQLite",
            source,
        },
    }
}

/// Errors: the database cannot be opened or written.
async fn check_connection(options: &SqliteConnectOptions) -> Result<(), sqlx::Error> {
    let mut connection = SqliteConnection::connect_with(options).await?;
    refuse_read_only(&mut connection).await?;
    connection.close().await
}

/// SQLite opens a file that cannot be written for reading, and such a connection would never write again, also if the file
/// can be written later. Errors: the connection cannot write.
async fn refuse_read_only(connection: &mut SqliteConnection) -> Result<(), sqlx::Error> {
    // Without waiting for another writer.
    sqlx::raw_sql("PRAGMA busy_timeout = 0")
        .execute(&mut *connection)
        .await?;
    // BEGIN alone succeeds where nothing can be written. Nothing of this is kept.
    let write = "BEGIN IMMEDIATE; CREATE TABLE write_check (id INTEGER); ROLLBACK";
    match sqlx::raw_sql(write).execute(&mut *connection).await {
        Err(error) if sqlite_code(&error) != Some(SQLITE_BUSY) => return Err(error),
        _ => {}
    }
    let restore = format!("PRAGMA busy_timeout = {}", BUSY_TIMEOUT.as_millis());
    let restored = sqlx::raw_sql(AssertSqlSafe(restore)).execute(connection).await;
    restored.map(drop)
}

/// Errors: `Damaged` if the database's structure is not sound.
async fn check_integrity(pool: &SqlitePool, path: &Path) -> Result<(), StoreError> {
    let found: Result<String, sqlx::Error> = sqlx::query_scalar("PRAGMA quick_check(1)").fetch_one(pool).await;
    match found {
        Ok(found) if found == "ok" => Ok(()),
        Ok(reason) => Err(StoreError::Damaged {
            path: path.to_owned(),
            reason: reason.replace('\n', "; "),
        }),
        Err(error) => Err(sqlite_failed(path, error)),
    }
}

const SQLITE_BUSY: i32 = 5;
const SQLITE_READONLY: i32 = 8;
const SQLITE_IOERR: i32 = 10;
const SQLITE_CORRUPT: i32 = 11;
const SQLITE_FULL: i32 = 13;
const SQLITE_CANTOPEN: i32 = 14;
const SQLITE_NOTADB: i32 = 26;

/// SQLite's primary error code.
fn sqlite_code(error: &sqlx::Error) -> Option<i32> {
    let database = error
        .as_database_error()?
        .try_downcast_ref::<sqlx::sqlite::SqliteError>()?;
    let code: i32 = sqlx::error::DatabaseError::code(database)?.parse().ok()?;
    Some(code & 0xff)
}

/// Whether the database cannot be reached or written now, but may be later.
pub(super) fn is_unavailable(error: &sqlx::Error) -> bool {
    match error {
        sqlx::Error::Io(_)
        | sqlx::Error::Tls(_)
        | sqlx::Error::PoolTimedOut
        | sqlx::Error::PoolClosed
        | sqlx::Error::WorkerCrashed => true,
        sqlx::Error::Database(_) => match sqlite_code(error) {
            Some(code) => matches!(
                code,
                SQLITE_BUSY | SQLITE_READONLY | SQLITE_IOERR | SQLITE_FULL | SQLITE_CANTOPEN
            ),
            // Connection exceptions, lack of resources, operator intervention (for example a shutdown), and a server that only
            // reads for now, as a replica does until it takes over.
            None => error
                .as_database_error()
                .and_then(sqlx::error::DatabaseError::code)
                .is_some_and(|code| ["08", "53", "57", "25006"].iter().any(|class| code.starts_with(class))),
        },
        _ => false,
    }
}

fn open_failed(source: sqlx::Error) -> StoreError {
    match source {
        sqlx::Error::Tls(_) if !cfg!(feature = "cloud") => StoreError::NoTls,
        source => StoreError::Open {
            database: "PostgreSQL",
            source,
        },
    }
}

fn migrations() -> Migrator {
    let migration = |&(version, name, sql): &(i64, &'static str, &'static str)| {
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator::with_migrations(MIGRATIONS.iter().map(migration).collect())
}
