//! Bags in SQLite databases (`.db3`), with the tables `topics` and `messages` of rosbag2.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use rusqlite::{Connection, OpenFlags};

use super::collector::{Collector, Position};
use crate::dataset::import::{ImportError, open_file};

/// Opens a database, perhaps even if it was cut off.
fn connect(path: &Path, even_if_cut: bool) -> Result<Connection, ImportError> {
    // A missing file is an error of the file, not of the database.
    open_file(path)?;
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX | OpenFlags::SQLITE_OPEN_URI;
    let connection = Connection::open_with_flags(uri(path), flags).map_err(|error| unreadable(path, &error))?;
    // Sorting never writes files.
    connection
        .execute_batch("PRAGMA temp_store = MEMORY")
        .map_err(|error| unreadable(path, &error))?;
    if even_if_cut {
        // Otherwise SQLite refuses a file that has fewer pages than its header says. Nothing is written.
        let relaxed = connection.execute_batch("PRAGMA writable_schema = ON");
        relaxed.map_err(|error| unreadable(path, &error))?;
    }
    Ok(connection)
}

/// The database's name. Without a write-ahead log it is opened as one that never changes, so that SQLite writes nothing beside it.
fn uri(path: &Path) -> PathBuf {
    let Some(text) = path.to_str() else {
        return path.to_owned();
    };
    let log = PathBuf::from(format!("{text}-wal"));
    let escaped = text.replace('%', "%25").replace('?', "%3f").replace('#', "%23");
    let option = if log.exists() { "" } else { "?immutable=1" };
    // Two slashes before a relative path would name a host.
    let root = if path.is_absolute() { "//" } else { "" };
    PathBuf::from(format!("file:{root}{escaped}{option}"))
}

/// Tables whose rows are computed could have no end. Errors: `Option`; `Record` if the database is damaged.
fn check_tables(connection: &Connection, path: &Path) -> Result<(), ImportError> {
    let computed = "SELECT count(*) FROM sqlite_master WHERE name IN ('messages', 'topics') AND (type <> 'table' \
         OR sql LIKE '%virtual%' OR sql LIKE '% as %(%')";
    let count: i64 = connection
        .query_row(computed, [], |row| row.get(0))
        .map_err(|error| unreadable(path, &error))?;
    if count > 0 {
        return Err(ImportError::Option(format!(
            "{}: its messages or topics are computed (a view, a virtual table or a generated column); a bag has plain tables",
            path.display()
        )));
    }
    Ok(())
}

fn unreadable(path: &Path, error: &rusqlite::Error) -> ImportError {
    ImportError::record(
        path.display().to_string(),
        format!("this is not a bag in an SQLite database, or it is damaged: {error}"),
    )
}

/// Passes every message of a file to the collector, in the order of recording. Errors: `Io`, `Record` where damage may not be
/// left out.
pub(super) fn scan(path: &Path, collector: &mut Collector<'_>) -> Result<(), ImportError> {
    let connection = connect(path, collector.options.skip_bad)?;
    check_tables(&connection, path)?;
    let topics = topics(&connection, path, collector)?;
    let mut statement = connection
        .prepare("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id")
        .map_err(|error| unreadable(path, &error))?;
    let mut rows = statement.query([]).map_err(|error| unreadable(path, &error))?;
    let mut last = 0;
    loop {
        let place = |row: i64| format!("{} row {row} of the messages", path.display());
        let row = match rows.next() {
            Ok(Some(row)) => row,
            Ok(None) => return Ok(()),
            Err(error) => {
                let reason = format!("the database cannot be read after this row: {error}");
                return collector.fault(place(last), reason);
            }
        };
        let read = || Ok::<_, rusqlite::Error>((row.get(0)?, row.get::<_, i64>(1)?, row.get(2)?, row.get_ref(3)?));
        let (id, topic, log_ns, data) = match read() {
            Ok((id, topic, log_ns, data)) => (id, topic, log_ns, data.as_blob().ok()),
            Err(error) => {
                collector.fault(place(last + 1), format!("the row cannot be read: {error}"))?;
                continue;
            }
        };
        last = id;
        let known = topics.iter().find(|(of, _)| *of == topic).map(|(_, topic)| *topic);
        match (known, data) {
            (Some(topic), Some(data)) => collector.message(topic, log_ns, Position::Row(id), data),
            (None, _) => collector.fault(place(id), format!("its topic_id {topic} is not in the table of topics"))?,
            (_, None) => collector.fault(place(id), "its data is not a blob".to_owned())?,
        }
    }
}

/// The topics by their number in the database.
fn topics(
    connection: &Connection,
    path: &Path,
    collector: &mut Collector<'_>,
) -> Result<Vec<(i64, usize)>, ImportError> {
    let failed = |error: rusqlite::Error| unreadable(path, &error);
    let mut statement = connection
        .prepare("SELECT id, name, type, serialization_format FROM topics ORDER BY id")
        .map_err(failed)?;
    let found = statement.query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?)));
    let found = found.map_err(failed)?;
    let mut topics = Vec::new();
    for row in found {
        let (id, name, type_name, encoding): (i64, String, String, String) = row.map_err(failed)?;
        match collector.topic(name, type_name, encoding) {
            Ok(topic) => topics.push((id, topic)),
            Err(reason) => collector.fault(format!("{} topic {id}", path.display()), reason)?,
        }
    }
    Ok(topics)
}

/// A database whose messages are read by their row.
pub(super) struct SqliteFile {
    path: PathBuf,
    connection: Mutex<Connection>,
}

impl SqliteFile {
    /// Errors: `Io`, `Record`.
    pub(super) fn open(path: &Path) -> Result<Self, ImportError> {
        Ok(Self {
            path: path.to_owned(),
            connection: Mutex::new(connect(path, true)?),
        })
    }

    /// The message of a row. Errors: `Record`.
    pub(super) fn message(&self, position: Position) -> Result<Vec<u8>, ImportError> {
        let Position::Row(row) = position else {
            let place = self.path.display().to_string();
            return Err(ImportError::record(place, "a message of it has no row"));
        };
        let connection = self.connection.lock().unwrap_or_else(PoisonError::into_inner);
        let read = connection
            .prepare("SELECT data FROM messages WHERE id = ?1")
            .and_then(|mut statement| statement.query_row([row], |row| row.get(0)));
        read.map_err(|error| {
            ImportError::record(
                format!("{} row {row} of the messages", self.path.display()),
                format!("the row cannot be read: {error}"),
            )
        })
    }
}
