//! Opens SQLite's database, and checks that it can be written and is not damaged.

use std::path::{Path, PathBuf};
use std::str::FromStr as _;

use sqlx::error::DatabaseError as _;
use sqlx::migrate::Migrator;
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteConnection, SqliteError, SqliteJournalMode, SqlitePool, SqlitePoolOptions,
};
use sqlx::{AssertSqlSafe, Connection as _};

use super::objects::on_disk;
use super::{BUSY_TIMEOUT, MAX_CONNECTIONS, StoreError, wal};
use foreframe_core::files::open_lock;

const BUSY: i32 = 5;
const READONLY: i32 = 8;
const IOERR: i32 = 10;
const CORRUPT: i32 = 11;
const FULL: i32 = 13;
const CANTOPEN: i32 = 14;
const NOTADB: i32 = 26;

/// Opens a database, creates it if it is missing, and migrates its tables. With `is_first`, checks its integrity before.
/// Errors: `Open`, `Damaged`, `Migrate`, `Io`.
pub(super) async fn open(
    options: SqliteConnectOptions,
    is_first: bool,
    migrations: &Migrator,
) -> Result<SqlitePool, StoreError> {
    let path = options.get_filename().to_owned();
    // SQLite's migrations take no lock, and two processes can start at the same time.
    let lock = |path: &Path| {
        let lock = open_lock(path)?;
        lock.lock().map(|()| lock)
    };
    let _lock = on_disk("lock", &path.with_extension("lock"), lock).await?;
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
        .map_err(|source| open_failed(&path, source))?;
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
        .map_err(|source| open_failed(&path, source))?;
    if is_first {
        check_integrity(&pool, &path).await?;
    }
    migrations.run(&pool).await.map_err(StoreError::Migrate)?;
    Ok(pool)
}

/// The file that a URL names; `None` if it does not name SQLite. Errors: `Open`.
pub(super) fn file_of(url: &str) -> Result<Option<PathBuf>, StoreError> {
    let options = url.starts_with("sqlite:").then(|| options(url)).transpose()?;
    Ok(options.map(|options| options.get_filename().to_owned()))
}

/// The options in a URL of SQLite. Errors: `Open`.
pub(super) fn options(url: &str) -> Result<SqliteConnectOptions, StoreError> {
    SqliteConnectOptions::from_str(url).map_err(|source| StoreError::open("SQLite", source))
}

fn open_failed(path: &Path, source: sqlx::Error) -> StoreError {
    match code(&source) {
        Some(CORRUPT | NOTADB) => damaged(path, source.to_string()),
        _ => StoreError::open("SQLite", source),
    }
}

fn damaged(path: &Path, reason: String) -> StoreError {
    let path = path.to_owned();
    StoreError::Damaged { path, reason }
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
        Err(error) if code(&error) != Some(BUSY) => return Err(error),
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
        Ok(reason) => Err(damaged(path, reason.replace('\n', "; "))),
        Err(error) => Err(open_failed(path, error)),
    }
}

/// SQLite's primary error code.
fn code(error: &sqlx::Error) -> Option<i32> {
    let error = error.as_database_error()?.try_downcast_ref::<SqliteError>()?;
    let code: i32 = error.code()?.parse().ok()?;
    Some(code & 0xff)
}

/// Whether SQLite's error passes: the database cannot be written now, but may be later. `None` if it is no error of SQLite.
pub(super) fn is_unavailable(error: &sqlx::Error) -> Option<bool> {
    code(error).map(|code| [BUSY, READONLY, IOERR, FULL, CANTOPEN].contains(&code))
}
