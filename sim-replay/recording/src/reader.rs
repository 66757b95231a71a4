//! Reader of recordings.

use std::path::Path;

use protocol::{Header, Key, wire};

use super::damage::Damage;
use super::mcap_file::{McapFile, McapPlace, is_foreign};
use super::{OWN_ENCODING, RecordingError};

/// A message of a recording: its position and its header.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Key on which it was published.
    pub key: Key,
    /// Its header.
    pub header: Header,
    /// Time of arrival at the recorder, nanoseconds on the Unix clock.
    pub arrived_nanos: u64,
    place: McapPlace,
}

/// A recording whose messages can be read in any order.
#[derive(Debug)]
pub struct Recording {
    pub(super) file: McapFile,
    entries: Vec<Entry>,
}

impl Recording {
    /// Opens a recording, as [`McapFile::open`].
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be read or is no recording of this program.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        // Reads the summary alone, where opening scans the whole file.
        if is_foreign(path)? {
            return Err(RecordingError::foreign(path, String::new()));
        }
        let (mut has_any, mut has_own) = (false, false);
        let (mut entries, mut no_key) = (Vec::new(), None);
        let file = McapFile::open(path, &mut |message, place| {
            has_any = true;
            if message.channel.message_encoding != OWN_ENCODING {
                return false;
            }
            has_own = true;
            // A payload that was no valid message when it was recorded is skipped.
            let header = wire::decode_header([message.data.as_ref()]).ok();
            let key = message.channel.topic.parse::<Key>();
            let key = key.inspect_err(|error| no_key = Some(error.clone()));
            let entry = key.ok().zip(header).map(|(key, header)| Entry {
                key,
                header,
                arrived_nanos: message.log_time,
                place,
            });
            let is_kept = entry.is_some();
            entries.extend(entry);
            is_kept
        })?;
        if !has_own {
            let first = file.damage().first();
            let what = first.map_or(String::new(), |damage| format!("; {damage}"));
            // Messages of other programs, or none in a whole file: foreign. Else damage may have taken ours.
            return Err(match has_any || file.damage().is_empty() {
                true => RecordingError::foreign(path, what),
                false => {
                    let reason = format!("none of its messages can be read{what}");
                    RecordingError::not_ours(path, reason)
                }
            });
        }
        if let (true, Some(error)) = (entries.is_empty(), no_key) {
            let reason = format_args!("none of its messages can be read: {error}");
            return Err(RecordingError::not_ours(path, reason));
        }
        Ok(Self { file, entries })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// The messages, in the order in which they were recorded.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The parts of the file that could not be read, in its order.
    pub fn damage(&self) -> &[Damage] {
        self.file.damage()
    }

    /// The bytes of a message, as transmitted.
    ///
    /// # Errors
    /// As [`McapFile::read`].
    pub fn read(&self, entry: &Entry) -> Result<Vec<u8>, RecordingError> {
        self.file.read(entry.place)
    }
}
