//! Bags in SQLite databases (`.db3`), with the tables `topics` and `messages` of rosbag2.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use rusqlite::Row;

use super::database::{BagDatabase, unreadable};
use super::index::{BagIndex, MessageFile, Position};
use crate::dataset::import::error::ImportError;

const MESSAGES: &str = "SELECT rowid, topic_id, timestamp, data FROM main.messages ORDER BY rowid";
const TOPICS: &str = "SELECT rowid, id, name, type, serialization_format FROM main.topics ORDER BY rowid";
/// In a damaged database, the same rows can follow each other without end.
const NOT_IN_ORDER: &str = "the database is damaged after this row: the next one has no greater number";

/// Passes every message of a file to the index, in the order of recording. Errors: `Io`, `Option`, `Stopped`, `Record` where
/// damage may not be left out.
pub(super) fn scan(path: &Path, index: &mut BagIndex<'_>) -> Result<(), ImportError> {
    let database = BagDatabase::open(path, index.options.skip_bad)?;
    let file = SqliteFile {
        path: path.to_owned(),
        database: Mutex::new(BagDatabase::open(path, true)?),
    };
    index.files.push(Arc::new(file));
    let topics = topics(&database, path, index)?;
    let wrong = |error: rusqlite::Error| unreadable(path, &error);
    database.begin_row();
    let mut statement = database.connection().prepare(MESSAGES).map_err(wrong)?;
    let mut rows = statement.query([]).map_err(wrong)?;
    let mut last = None;
    loop {
        index.check_cancelled()?;
        database.begin_row();
        let row = match rows.next() {
            Ok(Some(row)) => row,
            Ok(None) => return Ok(()),
            Err(error) => {
                let reason = format!("the database cannot be read after this row: {error}");
                return index.fault(place(path, last.unwrap_or_default()), reason);
            }
        };
        let id = row.get(0).map_err(wrong)?;
        if let Some(last) = last.filter(|last| *last >= id) {
            return index.fault(place(path, last), NOT_IN_ORDER);
        }
        last = Some(id);
        if let Err(reason) = take(row, id, &topics, index) {
            index.fault(place(path, id), reason)?;
        }
    }
}

/// Takes a message, whose topic's number is among `topics`. Errors: why it is damaged.
fn take(row: &Row<'_>, id: i64, topics: &[(i64, usize)], index: &mut BagIndex<'_>) -> Result<(), String> {
    let read = || Ok::<_, rusqlite::Error>((row.get::<_, i64>(1)?, row.get(2)?, row.get_ref(3)?.as_blob().ok()));
    let (topic, log_ns, data) = read().map_err(|error| format!("the row cannot be read: {error}"))?;
    let known = topics.binary_search_by_key(&topic, |(of, _)| *of);
    let known = known.map_err(|_| format!("its topic_id {topic} is not in the table of topics"))?;
    let position = Position {
        chunk: None,
        start: id as u64,
        bytes: 0,
    };
    index.message(topics[known].1, log_ns, position, data.ok_or("its data is not a blob")?);
    Ok(())
}

fn place(path: &Path, row: i64) -> String {
    format!("{} row {row} of the messages", path.display())
}

/// The topics by their number in the database, sorted. Errors: `Record`, `Stopped`.
fn topics(database: &BagDatabase, path: &Path, index: &mut BagIndex<'_>) -> Result<Vec<(i64, usize)>, ImportError> {
    let wrong = |error: rusqlite::Error| unreadable(path, &error);
    database.begin_row();
    let mut statement = database.connection().prepare(TOPICS).map_err(wrong)?;
    let mut rows = statement.query([]).map_err(wrong)?;
    let (mut topics, mut last) = (Vec::new(), None);
    while let Some(row) = rows.next().map_err(wrong)? {
        index.check_cancelled()?;
        database.begin_row();
        let number: i64 = row.get(0).map_err(wrong)?;
        if let Some(last) = last.filter(|last| *last >= number) {
            let place = format!("{} row {last} of the topics", path.display());
            return Err(ImportError::record(place, NOT_IN_ORDER));
        }
        last = Some(number);
        let read = || Ok((row.get(1)?, row.get(2)?, row.get(3)?, row.get(4)?));
        let (id, name, type_name, encoding) = read().map_err(wrong)?;
        match index.topic(name, type_name, encoding) {
            Ok(topic) => topics.push((id, topic)),
            Err(reason) => index.fault(format!("{} topic {id}", path.display()), reason)?,
        }
    }
    topics.sort_by_key(|(id, _)| *id);
    Ok(topics)
}

/// A database whose messages are read by their row.
struct SqliteFile {
    path: PathBuf,
    database: Mutex<BagDatabase>,
}

impl MessageFile for SqliteFile {
    fn message(&self, position: Position) -> Result<Vec<u8>, ImportError> {
        let database = self.database.lock().unwrap_or_else(PoisonError::into_inner);
        database.begin_row();
        let read = database
            .connection()
            .prepare("SELECT data FROM main.messages WHERE rowid = ?1")
            .and_then(|mut statement| statement.query_row([position.start as i64], |row| row.get(0)));
        read.map_err(|error| ImportError::record(self.place(position), format!("the row cannot be read: {error}")))
    }

    fn place(&self, position: Position) -> String {
        place(&self.path, position.start as i64)
    }
}
