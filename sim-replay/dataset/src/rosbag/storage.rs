//! Storage of a bag: its files, scanned once in order, and their messages by position.

use std::path::{Path, PathBuf};

use recording::McapFile;
use tempfile::TempPath;

use super::files::{BagKind, unpacked, unpacked_message};
use super::scan::{At, BagMessage, BagTopic, MessagePlace, Scan};
use super::sqlite::SqliteFile;
use crate::recorded::as_read_error;
use crate::{ReadError, Result};

/// The files of a bag.
#[derive(Debug)]
pub(super) struct Storage(Vec<BagFile>);

#[derive(Debug)]
struct BagFile {
    path: PathBuf,
    form: Form,
    /// An unpacked copy is deleted with the value.
    _unpacked: Option<TempPath>,
}

#[derive(Debug)]
enum Form {
    Mcap(McapFile),
    Sqlite(SqliteFile),
}

impl Storage {
    /// Opens files and scans them. Files and parts of files that cannot be read are left out, with a problem.
    ///
    /// # Errors
    /// [`ReadError`] of the first file if none can be read.
    pub(super) fn open(
        paths: &[PathBuf],
        scan: &mut dyn Scan,
        problems: &mut Vec<ReadError>,
    ) -> Result<Self> {
        let (mut files, mut faults) = (Vec::new(), Vec::new());
        for path in paths {
            match BagFile::open(path, files.len(), scan, problems) {
                Ok(file) => files.push(file),
                Err(fault) => {
                    scan.forget(files.len());
                    faults.push(fault);
                }
            }
        }
        if files.is_empty() && !faults.is_empty() {
            return Err(faults.swap_remove(0));
        }
        let faults = faults.into_iter();
        problems.extend(faults.map(|fault| fault.with_consequence("the file is left out")));
        Ok(Self(files))
    }

    /// All files with messages.
    pub(super) fn paths(&self) -> Vec<PathBuf> {
        self.0.iter().map(|file| file.path.clone()).collect()
    }

    /// The file of a message.
    pub(super) fn path(&self, place: MessagePlace) -> &Path {
        self.0
            .get(place.file)
            .map_or(Path::new(""), |file| &file.path)
    }

    /// The bytes of a message in CDR.
    pub(super) fn read(&self, place: MessagePlace) -> Result<Vec<u8>> {
        let path = self.path(place);
        let data = match (self.0.get(place.file).map(|file| &file.form), place.at) {
            (Some(Form::Mcap(file)), At::Mcap(at)) => file.read(at).map_err(as_read_error)?,
            (Some(Form::Sqlite(file)), At::Row(row)) => file.read(row).map_err(|error| {
                let reason = format!("SQLite: row {row} of messages: {error}");
                ReadError::malformed(path, reason)
            })?,
            _ => return Err(ReadError::malformed(path, "the bag has no such message")),
        };
        let message = unpacked_message(&data);
        let message = message.map_err(|error| ReadError::malformed(path, error.to_string()))?;
        Ok(message.into_owned())
    }
}

impl BagFile {
    fn open(
        path: &Path,
        index: usize,
        scan: &mut dyn Scan,
        problems: &mut Vec<ReadError>,
    ) -> Result<Self> {
        let kind = BagKind::of(path);
        if kind == Some(BagKind::Ros1) {
            let reason = "a bag of ROS 1: `rosbags-convert --src FILE.bag --dst FOLDER` makes one of ROS 2 of it";
            return Err(ReadError::malformed(path, reason));
        }
        let unpacked = unpacked(path)?;
        let paths = (path, unpacked.as_deref().unwrap_or(path));
        let form = match kind {
            Some(BagKind::Sqlite) => Form::Sqlite(SqliteFile::scan(paths, index, scan, problems)?),
            _ => Form::Mcap(scan_mcap(paths, index, scan, problems)?),
        };
        Ok(Self {
            path: path.to_owned(),
            form,
            _unpacked: unpacked,
        })
    }
}

fn scan_mcap(
    (name, path): (&Path, &Path),
    file: usize,
    scan: &mut dyn Scan,
    problems: &mut Vec<ReadError>,
) -> Result<McapFile> {
    let mcap = McapFile::open(path, &mut |message, at| {
        let channel = &message.channel;
        let schema = channel.schema.as_ref();
        let topic = BagTopic {
            name: channel.topic.clone(),
            type_name: schema.map_or(String::new(), |schema| schema.name.clone()),
            encoding: channel.message_encoding.clone(),
        };
        let is_wanted = scan.declare(&topic);
        if is_wanted {
            let at = At::Mcap(at);
            scan.take(BagMessage {
                topic: &topic,
                recorded_nanos: message.log_time,
                data: unpacked_message(&message.data).map_err(|error| error.to_string()),
                place: MessagePlace { file, at },
            });
        }
        is_wanted
    });
    let mcap = mcap.map_err(as_read_error)?;
    let damage = mcap.damage().iter().map(ToString::to_string);
    problems.extend(damage.map(|damage| ReadError::malformed(name, damage)));
    Ok(mcap)
}
