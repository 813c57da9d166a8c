//! SQLite and PostgreSQL behind one interface: both get the same statements and values. All differences are here. sqlx's own
//! driver for any database takes its options from a URL alone, which has no busy timeout and not every path.

use std::path::Path;
use std::time::Duration;

use futures_util::future::BoxFuture;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::postgres::{PgConnection, PgPool, PgPoolOptions};
use sqlx::query::Query;
use sqlx::sqlite::{SqliteConnectOptions, SqlitePool};
use sqlx::{
    AssertSqlSafe, Column as _, ColumnIndex, Connection as _, Decode, Encode, Postgres, Row, SqlSafeStr, Sqlite,
    Transaction, Type,
};

use super::job_id::JobId;
use super::{BUSY_TIMEOUT, DATABASE_FILE, MAX_CONNECTIONS, StoreConfig, StoreError, sqlite};
use foreframe_core::types::ModelName;

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
    (4, "after", include_str!("migrations/0004_after.sql")),
    (5, "parts", include_str!("migrations/0005_parts.sql")),
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
value_from!(Text: &str => |text: &str| Some(text.to_owned()), &ModelName => |name: &ModelName| Some(name.to_string()),
    String => Some, Option<String> => |text| text);
value_from!(Int: i64 => Some, Option<i64> => |int| int, u32 => |int| Some(i64::from(int)),
    JobId => |id: JobId| Some(id.number()));
value_from!(Real: f64 => Some, Option<f64> => |real| real);

/// The parameters of a statement.
pub(super) type Values = Vec<DatabaseValue>;

/// Makes the parameters of a statement.
macro_rules! values {
    ($($value:expr),* $(,)?) => {
        vec![$($crate::store::database::DatabaseValue::from($value)),*]
    };
}
pub(super) use values;

/// A row of a result: the values by the names of their columns.
pub(super) struct DatabaseRow(Map<String, Value>);

impl DatabaseRow {
    /// The value in a column. Errors: `Query` if there is no column of that name and type.
    pub(super) fn get<T: DeserializeOwned>(&self, column: &str) -> Result<T, StoreError> {
        let value = self.0.get(column);
        let value = value.ok_or_else(|| StoreError::Query(sqlx::Error::ColumnNotFound(column.to_owned())))?;
        T::deserialize(value).map_err(undecoded)
    }

    /// The row as a structure with a field for each column that it needs. Errors: `Query` if a column is missing or of another
    /// type.
    pub(super) fn read<T: DeserializeOwned>(self) -> Result<T, StoreError> {
        serde_json::from_value(Value::Object(self.0)).map_err(undecoded)
    }
}

fn undecoded(error: serde_json::Error) -> StoreError {
    StoreError::Query(sqlx::Error::Decode(error.into()))
}

/// The structures of all rows. Errors: `Query` if a column is missing or of another type.
pub(super) fn read_all<T: DeserializeOwned>(rows: Vec<DatabaseRow>) -> Result<Vec<T>, StoreError> {
    rows.into_iter().map(DatabaseRow::read).collect()
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

fn bind<'q, DB: sqlx::Database>(sql: impl SqlSafeStr, values: Values) -> Query<'q, DB, DB::Arguments>
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

fn decoded<R: Row>(rows: Vec<R>) -> Result<Vec<DatabaseRow>, StoreError>
where
    usize: ColumnIndex<R>,
    for<'r> Option<i64>: Decode<'r, R::Database> + Type<R::Database>,
    for<'r> Option<f64>: Decode<'r, R::Database> + Type<R::Database>,
    for<'r> Option<String>: Decode<'r, R::Database> + Type<R::Database>,
{
    let value = |row: &R, at: usize| {
        let int = row.try_get::<Option<i64>, _>(at).map(Value::from);
        let int_or_real = int.or_else(|_| row.try_get::<Option<f64>, _>(at).map(Value::from));
        int_or_real.or_else(|_| row.try_get::<Option<String>, _>(at).map(Value::from))
    };
    let values = |row: R| {
        let columns = row.columns().iter();
        let named = columns.map(|column| Ok((column.name().to_owned(), value(&row, column.ordinal())?)));
        named.collect::<Result<_, sqlx::Error>>().map(DatabaseRow)
    };
    Ok(rows.into_iter().map(values).collect::<Result<_, _>>()?)
}

/// A statement that returns a row for each row that it changes.
fn with_changed_rows(sql: &str) -> impl SqlSafeStr {
    AssertSqlSafe(format!("{sql} RETURNING CAST(1 AS BIGINT) AS changed"))
}

impl Database {
    pub(super) async fn open(config: &StoreConfig, is_first: bool) -> Result<Self, StoreError> {
        let options = match config.database.as_deref().map(|url| (url, url.split(':').next())) {
            None => SqliteConnectOptions::new().filename(config.data_dir.join(DATABASE_FILE)),
            Some((url, Some("sqlite"))) => sqlite::options(url)?,
            Some((url, Some("postgres" | "postgresql"))) => return Box::pin(Self::open_postgres(url)).await,
            Some((url, _)) => {
                let expected = "sqlite:FILE or postgres://USER@HOST/NAME";
                return Err(StoreError::url("database", url, expected));
            }
        };
        sqlite::open(options, is_first, &migrations()).await.map(Self::Sqlite)
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
        let now = self.first(sql, values![]).await?;
        now.ok_or(StoreError::Query(sqlx::Error::RowNotFound))?.get("now_s")
    }

    /// Moves everything from the write-ahead log into the database file and closes all connections.
    pub(super) async fn close(&self) -> Result<(), StoreError> {
        match self {
            Self::Sqlite(pool) => {
                let checkpointed = self.fetch("PRAGMA wal_checkpoint(TRUNCATE)", values![]).await;
                pool.close().await;
                checkpointed.map(drop)
            }
            Self::Postgres(pool) => {
                pool.close().await;
                Ok(())
            }
        }
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
                return Err(StoreError::open(
                    "PostgreSQL",
                    reason.unwrap_or(sqlx::Error::PoolTimedOut),
                ));
            }
            Err(error) => return Err(StoreError::open("PostgreSQL", error)),
        };
        migrations().run(&pool).await.map_err(StoreError::Migrate)?;
        Ok(Self::Postgres(pool))
    }

    /// The rows of a query.
    pub(super) async fn fetch(&self, sql: impl SqlSafeStr, values: Values) -> Result<Vec<DatabaseRow>, StoreError> {
        match self {
            Self::Sqlite(pool) => decoded(bind::<Sqlite>(sql, values).fetch_all(pool).await?),
            Self::Postgres(pool) => decoded(within_limit(bind::<Postgres>(sql, values).fetch_all(pool)).await?),
        }
    }

    /// The first row of a query.
    pub(super) async fn first(&self, sql: &'static str, values: Values) -> Result<Option<DatabaseRow>, StoreError> {
        Ok(self.fetch(sql, values).await?.into_iter().next())
    }

    /// The structure of the first row.
    pub(super) async fn read_first<T: DeserializeOwned>(
        &self,
        sql: &'static str,
        values: Values,
    ) -> Result<Option<T>, StoreError> {
        self.first(sql, values).await?.map(DatabaseRow::read).transpose()
    }

    /// How many rows a statement changed.
    pub(super) async fn execute(&self, sql: &'static str, values: Values) -> Result<u64, StoreError> {
        Ok(self.fetch(with_changed_rows(sql), values).await?.len() as u64)
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
    /// The rows of a query.
    pub(super) async fn fetch(&mut self, sql: impl SqlSafeStr, values: Values) -> Result<Vec<DatabaseRow>, StoreError> {
        match self {
            Self::Sqlite(tx) => decoded(bind::<Sqlite>(sql, values).fetch_all(&mut **tx).await?),
            Self::Postgres(tx) => decoded(within_limit(bind::<Postgres>(sql, values).fetch_all(&mut **tx)).await?),
        }
    }

    /// The first row of a query.
    pub(super) async fn first(
        &mut self,
        sql: impl SqlSafeStr,
        values: Values,
    ) -> Result<Option<DatabaseRow>, StoreError> {
        Ok(self.fetch(sql, values).await?.into_iter().next())
    }

    /// As `first`, but locks the row and skips those that another transaction has locked.
    pub(super) async fn first_free(
        &mut self,
        sql: &'static str,
        values: Values,
    ) -> Result<Option<DatabaseRow>, StoreError> {
        match self {
            Self::Sqlite(_) => self.first(sql, values).await,
            Self::Postgres(_) => {
                self.first(AssertSqlSafe(format!("{sql} FOR UPDATE SKIP LOCKED")), values)
                    .await
            }
        }
    }

    /// Locks the numbers of jobs and of versions until the end of the transaction.
    pub(super) async fn lock_numbers(&mut self) -> Result<(), StoreError> {
        let sql = "UPDATE counters SET value = value WHERE name = 'job'";
        self.execute(sql, values![]).await.map(drop)
    }

    /// How many rows a statement changed.
    pub(super) async fn execute(&mut self, sql: &'static str, values: Values) -> Result<u64, StoreError> {
        Ok(self.fetch(with_changed_rows(sql), values).await?.len() as u64)
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

/// Whether the database cannot be reached or written now, but may be later.
pub(super) fn is_unavailable(error: &sqlx::Error) -> bool {
    match error {
        sqlx::Error::Io(_)
        | sqlx::Error::Tls(_)
        | sqlx::Error::PoolTimedOut
        | sqlx::Error::PoolClosed
        | sqlx::Error::WorkerCrashed => true,
        sqlx::Error::Database(other) => sqlite::is_unavailable(error).unwrap_or_else(|| {
            // Connection exceptions, lack of resources, operator intervention (for example a shutdown), and a server that only
            // reads for now, as a replica does until it takes over.
            let code = other.code().unwrap_or_default();
            ["08", "53", "57", "25006"].iter().any(|class| code.starts_with(class))
        }),
        _ => false,
    }
}

fn migrations() -> Migrator {
    let migration = |&(version, name, sql): &(i64, &'static str, &'static str)| {
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator::with_migrations(MIGRATIONS.iter().map(migration).collect())
}
