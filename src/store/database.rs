//! SQLite and PostgreSQL behind one interface: both get the same statements and values. All differences are here.

use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::postgres::{PgConnection, PgPool, PgPoolOptions, PgRow};
use sqlx::query::Query;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteRow};
use sqlx::{
    AssertSqlSafe, Connection as _, Decode, Encode, Postgres, Row as _, SqlSafeStr as _, SqlStr, Sqlite, Transaction,
    Type,
};

use super::StoreError;

/// The maximum number of connections to the database.
const MAX_CONNECTIONS: u32 = 8;
/// How long a statement waits for a connection or, on SQLite, for another writer.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);

const MIGRATIONS: &[(i64, &str, &str)] = &[
    (1, "initial", include_str!("migrations/0001_initial.sql")),
    (
        2,
        "attempts and metrics",
        include_str!("migrations/0002_attempts_and_metrics.sql"),
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
value_from!(Text: &str => |text: &str| Some(text.to_owned()), String => Some, Option<String> => |text| text,
    Option<&str> => |text: Option<&str>| text.map(str::to_owned));
value_from!(Int: i64 => Some, Option<i64> => |int| int, u32 => |int| Some(i64::from(int)));
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
    pub(super) async fn open(url: &str) -> Result<Self, StoreError> {
        let scheme = url.split(':').next().unwrap_or_default();
        match scheme {
            "sqlite" => {
                let options = SqliteConnectOptions::from_str(url).map_err(|source| StoreError::Open {
                    database: "SQLite",
                    source,
                })?;
                Self::open_sqlite(options).await
            }
            "postgres" | "postgresql" => Box::pin(Self::open_postgres(url)).await,
            _ => Err(StoreError::Url {
                flag: "database",
                scheme: scheme.chars().take(16).collect(),
                expected: "sqlite:FILE or postgres://USER@HOST/NAME",
            }),
        }
    }

    pub(super) async fn open_file(path: &Path) -> Result<Self, StoreError> {
        Self::open_sqlite(SqliteConnectOptions::new().filename(path)).await
    }

    async fn open_sqlite(options: SqliteConnectOptions) -> Result<Self, StoreError> {
        // SQLite's migrations take no lock, and two processes can start at the same time.
        let lock_path = options.get_filename().with_extension("lock");
        let failed = StoreError::io("lock", &lock_path);
        let locked = tokio::task::spawn_blocking(move || {
            let lock = std::fs::File::create(&lock_path)?;
            lock.lock().map(|()| lock)
        });
        let _lock = locked.await.unwrap_or_else(|error| Err(error.into())).map_err(failed)?;
        let options = options
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .busy_timeout(BUSY_TIMEOUT);
        let pool = SqlitePoolOptions::new()
            .max_connections(MAX_CONNECTIONS)
            .acquire_timeout(BUSY_TIMEOUT)
            .connect_with(options)
            .await
            .map_err(|source| StoreError::Open {
                database: "SQLite",
                source,
            })?;
        migrations().run(&pool).await.map_err(StoreError::Migrate)?;
        Ok(Self::Sqlite(pool))
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
                let reason = PgConnection::connect(url).await.err();
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
            Self::Postgres(pool) => postgres_rows(bind::<Postgres>(sql, values).fetch_all(pool).await?),
        })
    }

    /// How many rows a statement changed.
    pub(super) async fn execute(&self, sql: &'static str, values: Vec<DatabaseValue>) -> Result<u64, StoreError> {
        let sql = sql.into_sql_str();
        Ok(match self {
            Self::Sqlite(pool) => bind::<Sqlite>(sql, values).execute(pool).await?.rows_affected(),
            Self::Postgres(pool) => bind::<Postgres>(sql, values).execute(pool).await?.rows_affected(),
        })
    }

    /// Begins a write transaction.
    pub(super) async fn begin(&self) -> Result<Tx, StoreError> {
        Ok(match self {
            Self::Sqlite(pool) => Tx::Sqlite(pool.begin_with("BEGIN IMMEDIATE").await?),
            Self::Postgres(pool) => Tx::Postgres(pool.begin().await?),
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
            Self::Postgres(tx) => postgres_rows(bind::<Postgres>(sql, values).fetch_all(&mut **tx).await?),
        })
    }

    pub(super) async fn execute(&mut self, sql: &'static str, values: Vec<DatabaseValue>) -> Result<u64, StoreError> {
        let sql = sql.into_sql_str();
        Ok(match self {
            Self::Sqlite(tx) => bind::<Sqlite>(sql, values).execute(&mut **tx).await?.rows_affected(),
            Self::Postgres(tx) => bind::<Postgres>(sql, values).execute(&mut **tx).await?.rows_affected(),
        })
    }

    pub(super) async fn commit(self) -> Result<(), StoreError> {
        let committed = match self {
            Self::Sqlite(tx) => tx.commit().await,
            Self::Postgres(tx) => tx.commit().await,
        };
        committed.map_err(StoreError::Query)
    }
}

fn sqlite_rows(rows: Vec<SqliteRow>) -> Vec<DatabaseRow> {
    rows.into_iter().map(DatabaseRow::Sqlite).collect()
}

fn postgres_rows(rows: Vec<PgRow>) -> Vec<DatabaseRow> {
    rows.into_iter().map(DatabaseRow::Postgres).collect()
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
