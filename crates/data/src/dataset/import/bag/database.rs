//! Opens SQLite databases that others made: nothing in them is computed, and nothing that SQLite does with them takes long.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use rusqlite::config::DbConfig;
use rusqlite::limits::Limit;
use rusqlite::{Connection, OpenFlags};

use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::{MAX_FILE_BYTES, open_file};

/// What a database may ask of SQLite. The tables of rosbag2 have less than ten columns and our statements are short; other tables of
/// the file may be larger.
const LIMITS: [(Limit, i32); 11] = [
    (Limit::SQLITE_LIMIT_LENGTH, MAX_FILE_BYTES as i32),
    (Limit::SQLITE_LIMIT_SQL_LENGTH, 1 << 20),
    (Limit::SQLITE_LIMIT_COLUMN, 2000),
    (Limit::SQLITE_LIMIT_EXPR_DEPTH, 20),
    (Limit::SQLITE_LIMIT_COMPOUND_SELECT, 2),
    (Limit::SQLITE_LIMIT_VDBE_OP, 10_000),
    (Limit::SQLITE_LIMIT_FUNCTION_ARG, 8),
    (Limit::SQLITE_LIMIT_ATTACHED, 0),
    (Limit::SQLITE_LIMIT_LIKE_PATTERN_LENGTH, 100),
    (Limit::SQLITE_LIMIT_TRIGGER_DEPTH, 1),
    (Limit::SQLITE_LIMIT_WORKER_THREADS, 0),
];
/// After this number of instructions, SQLite calls our check of the bound.
const STEP_INSTRUCTIONS: i32 = 1000;
/// How many such calls the work on one row may take. Reading a row takes about ten instructions; all 5,000 calls together take less
/// than a second.
const MAX_STEPS: u32 = 5000;

/// The tables that are read, with the columns that are read of each.
const TABLES: [(&str, &str); 2] = [
    ("topics", "id,name,type,serialization_format"),
    ("messages", "topic_id,timestamp,data"),
];
/// A table in which SQLite finds no rows by their number, or whose rows are made by something else than its file.
const OTHER_TABLES: &str =
    "SELECT count(*) FROM pragma_table_list(?1) WHERE schema = 'main' AND (type <> 'table' OR wr)";
/// A column that is computed, or whose value need not be in the file, or that takes the name of the row's number.
const OTHER_COLUMNS: &str = "SELECT count(*) FROM pragma_table_xinfo(?1) WHERE hidden <> 0 OR name = 'rowid' COLLATE NOCASE \
     OR (dflt_value IS NOT NULL AND instr(',' || ?2 || ',', ',' || lower(name) || ','))";

/// An open database, whose `topics` and `messages`, if it has them, are plain tables. `rowid` is the number of their rows.
pub(super) struct BagDatabase {
    connection: Connection,
    steps: Arc<AtomicU32>,
}

impl BagDatabase {
    /// Opens a database, perhaps even if it was cut off. Errors: `Io`; `Option` if what is to be read is computed; `Record` if it is
    /// damaged.
    pub(super) fn open(path: &Path, even_if_cut: bool) -> Result<Self, ImportError> {
        // A missing file is an error of the file, not of the database.
        open_file(path)?;
        let wrong = |error: rusqlite::Error| unreadable(path, &error);
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX | OpenFlags::SQLITE_OPEN_URI;
        let connection = Connection::open_with_flags(uri(path), flags).map_err(wrong)?;
        let steps = Arc::new(AtomicU32::new(0));
        let database = Self { connection, steps };
        database.restrict(even_if_cut).map_err(wrong)?;
        if database.is_computed().map_err(wrong)? {
            return Err(ImportError::Option(format!(
                "{}: its messages or topics are computed (a view, a virtual table, a generated column or a default value); a bag \
                 has plain tables",
                path.display()
            )));
        }
        Ok(database)
    }

    /// Starts the work on the next row: the bound counts from here.
    pub(super) fn begin_row(&self) {
        self.steps.store(0, Ordering::Relaxed);
    }

    pub(super) fn connection(&self) -> &Connection {
        &self.connection
    }

    fn restrict(&self, even_if_cut: bool) -> rusqlite::Result<()> {
        let connection = &self.connection;
        for (limit, most) in LIMITS {
            connection.set_limit(limit, most)?;
        }
        let steps = Arc::clone(&self.steps);
        let is_too_long = move || steps.fetch_add(1, Ordering::Relaxed) >= MAX_STEPS;
        connection.progress_handler(STEP_INSTRUCTIONS, Some(is_too_long))?;
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_VIEW, false)?;
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_TRIGGER, false)?;
        // Sorting never writes files.
        connection.execute_batch(
            "PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON; PRAGMA mmap_size = 0; PRAGMA temp_store = MEMORY",
        )?;
        if even_if_cut {
            // Otherwise SQLite refuses a file that has fewer pages than its header says. The file's size is checked when reading
            // begins, and reading goes on until the connection is closed: the tables' descriptions are read strictly after it.
            connection.execute_batch(
                "PRAGMA writable_schema = ON; BEGIN; PRAGMA user_version; PRAGMA writable_schema = OFF",
            )?;
        }
        connection
            .set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true)
            .map(drop)
    }

    /// Whether SQLite itself says that one of the tables is not a plain one. SQLite ignores the case of names.
    fn is_computed(&self) -> rusqlite::Result<bool> {
        let mut count = 0;
        for (table, columns) in TABLES {
            self.begin_row();
            count += self
                .connection
                .query_row(OTHER_TABLES, [table], |row| row.get::<_, i64>(0))?;
            self.begin_row();
            let columns = (table, columns);
            count += self
                .connection
                .query_row(OTHER_COLUMNS, columns, |row| row.get::<_, i64>(0))?;
        }
        Ok(count > 0)
    }
}

/// The database's name. Without a write-ahead log and a rollback journal it is opened as one that never changes, so that SQLite
/// writes nothing beside it.
fn uri(path: &Path) -> PathBuf {
    let Some(text) = path.to_str() else {
        return path.to_owned();
    };
    let has = |ending: &str| PathBuf::from(format!("{text}{ending}")).exists();
    let escaped = text.replace('%', "%25").replace('?', "%3f").replace('#', "%23");
    let option = if has("-wal") || has("-journal") {
        ""
    } else {
        "?immutable=1"
    };
    // Two slashes before a relative path would name a host.
    let root = if path.is_absolute() { "//" } else { "" };
    PathBuf::from(format!("file:{root}{escaped}{option}"))
}

pub(super) fn unreadable(path: &Path, error: &rusqlite::Error) -> ImportError {
    let reason = match error.sqlite_error_code() {
        Some(rusqlite::ErrorCode::OperationInterrupted) => "it takes SQLite too long".to_owned(),
        _ => error.to_string(),
    };
    ImportError::record(
        path.display(),
        format!("this is not a bag in an SQLite database, or it is damaged: {reason}"),
    )
}
