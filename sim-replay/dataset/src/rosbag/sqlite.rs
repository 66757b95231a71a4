//! SQLite storage of a bag: tables `topics` and `messages`, as rosbag2 writes them.

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use rusqlite::{Connection, OpenFlags, Result};
use support::bounded_file;

use super::files::unpacked_message;
use super::scan::{At, BagMessage, BagTopic, MessagePlace, Scan};
use crate::ReadError;

/// An open database.
#[derive(Debug)]
pub(super) struct SqliteFile(Mutex<Connection>);

impl SqliteFile {
    /// Opens a database, file number `file` of its bag, and scans it, topic by topic in the order of the rows. Rows after
    /// one that cannot be read are left out, with a problem; `name` is the file in errors.
    pub(super) fn scan(
        (name, path): (&Path, &Path),
        file: usize,
        scan: &mut dyn Scan,
        problems: &mut Vec<ReadError>,
    ) -> std::result::Result<Self, ReadError> {
        // SQLite's own mutex is not needed: the connection is behind one here.
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        // Refuses pipes and devices before SQLite opens them.
        bounded_file::open(path).map_err(|error| ReadError::io(name, error))?;
        let connection =
            Connection::open_with_flags(path, flags).map_err(|error| fault(name, &error))?;
        for (id, topic) in topics(&connection).map_err(|error| fault(name, &error))? {
            if !scan.declare(&topic) {
                continue;
            }
            if let Err(error) = messages(&connection, (id, &topic), file, scan) {
                let rest = format!("the rows of {} after it are left out", topic.name);
                problems.push(fault(name, &error).with_consequence(&rest));
            }
        }
        Ok(Self(Mutex::new(connection)))
    }

    /// The bytes of the message in a row.
    pub(super) fn read(&self, row: i64) -> Result<Vec<u8>> {
        let connection = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut statement = connection.prepare("SELECT data FROM messages WHERE id = ?1")?;
        statement.query_row([row], |row| row.get(0))
    }
}

fn fault(name: &Path, error: &rusqlite::Error) -> ReadError {
    ReadError::malformed(name, format!("SQLite: {error}"))
}

/// Number and description of each topic.
fn topics(connection: &Connection) -> Result<Vec<(i64, BagTopic)>> {
    let mut statement =
        connection.prepare("SELECT id, name, type, serialization_format FROM topics")?;
    let topics = statement.query_map([], |row| {
        let topic = BagTopic {
            name: row.get(1)?,
            type_name: row.get(2)?,
            encoding: row.get(3)?,
        };
        Ok((row.get(0)?, topic))
    });
    topics?.collect()
}

fn messages(
    connection: &Connection,
    (id, topic): (i64, &BagTopic),
    file: usize,
    scan: &mut dyn Scan,
) -> Result<()> {
    let mut statement = connection
        .prepare("SELECT id, timestamp, data FROM messages WHERE topic_id = ?1 ORDER BY id")?;
    let mut rows = statement.query([id])?;
    while let Some(row) = rows.next()? {
        let recorded_nanos: i64 = row.get(1)?;
        let data = row.get_ref(2)?.as_blob()?;
        scan.take(BagMessage {
            topic,
            // SQLite has signed numbers only. A negative time counts as 0.
            recorded_nanos: u64::try_from(recorded_nanos).unwrap_or(0),
            data: unpacked_message(data).map_err(|error| error.to_string()),
            place: MessagePlace {
                file,
                at: At::Row(row.get(0)?),
            },
        });
    }
    Ok(())
}
