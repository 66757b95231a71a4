//! Record log: records of one type in a file, each with its length and checksum.
//!
//! The first line names the kind of the records. A file that ends within a record (power, `kill -9`) is read up to it.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, ErrorKind, Read, Write};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::bounded_file;
use crate::file_error::{AtFile, FileError};

/// Largest record, bytes: a dense feature map with 32-bit numbers takes a few MiB.
const MAX_RECORD_BYTES: u32 = 64 << 20;

/// Writer of a record log.
#[derive(Debug)]
pub struct RecordWriter<T> {
    out: BufWriter<File>,
    of: PhantomData<fn(T)>,
}

impl<T: Serialize> RecordWriter<T> {
    /// Creates the file for records of that kind; an older one is replaced.
    ///
    /// # Errors
    /// The system's, if the file cannot be written.
    pub fn create(path: &Path, kind: &str) -> io::Result<Self> {
        let mut out = BufWriter::new(File::create(path)?);
        out.write_all(first_line(kind).as_bytes())?;
        let of = PhantomData;
        Ok(Self { out, of })
    }

    /// Appends a record.
    ///
    /// # Errors
    /// The system's if the file cannot be written; [`ErrorKind::InvalidData`] for a record of more than 64 MiB.
    pub fn add(&mut self, record: &T) -> io::Result<()> {
        let config = bincode::config::standard();
        let bytes = bincode::serde::encode_to_vec(record, config).map_err(io::Error::other)?;
        let length = u32::try_from(bytes.len()).ok();
        let length = length.filter(|length| *length <= MAX_RECORD_BYTES);
        let length = length.ok_or(ErrorKind::InvalidData)?;
        self.out.write_all(&length.to_le_bytes())?;
        self.out.write_all(&crc32fast::hash(&bytes).to_le_bytes())?;
        self.out.write_all(&bytes)?;
        // After each record: a process that is killed loses none that was added.
        self.out.flush()
    }
}

/// Reader of a record log: its records in order. A damaged end is an error, after which there is no record.
#[derive(Debug)]
pub struct RecordReader<T> {
    path: PathBuf,
    file: Option<BufReader<File>>,
    of: PhantomData<fn() -> T>,
}

impl<T: DeserializeOwned> RecordReader<T> {
    /// Opens a file with records of that kind.
    ///
    /// # Errors
    /// [`FileError`] if the file cannot be read or is of another kind.
    pub fn open(path: &Path, kind: &str) -> Result<Self, FileError> {
        let mut file = BufReader::new(bounded_file::open(path).at(path)?);
        let expected = first_line(kind);
        let mut found = vec![0; expected.len()];
        let is_whole = file.read_exact(&mut found).is_ok();
        if !is_whole || found != expected.as_bytes() {
            let problem = format!("is no log of {kind}: it does not begin with {expected:?}");
            return Err(FileError::new(path, problem));
        }
        Ok(Self {
            path: path.to_owned(),
            file: Some(file),
            of: PhantomData,
        })
    }

    fn read(file: &mut impl Read) -> io::Result<Option<T>> {
        let (mut length, mut checksum) = ([0; 4], [0; 4]);
        let [first, rest @ ..] = &mut length;
        // No byte at all is the regular end, fewer than a whole record a damaged one.
        match file.read(std::slice::from_mut(first))? {
            0 => return Ok(None),
            _ => file.read_exact(rest)?,
        }
        file.read_exact(&mut checksum)?;
        let length = u32::from_le_bytes(length);
        // Grows with what is there: a damaged length reserves no memory.
        let mut bytes = Vec::new();
        file.take(u64::from(length.min(MAX_RECORD_BYTES)))
            .read_to_end(&mut bytes)?;
        if bytes.len() as u64 != u64::from(length) {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        if crc32fast::hash(&bytes) != u32::from_le_bytes(checksum) {
            return Err(io::Error::other("the checksum is wrong"));
        }
        // A length inside a record may claim more than the record holds.
        let config = bincode::config::standard().with_limit::<{ MAX_RECORD_BYTES as usize }>();
        let (record, _) =
            bincode::serde::decode_from_slice(&bytes, config).map_err(io::Error::other)?;
        Ok(Some(record))
    }
}

impl<T: DeserializeOwned> Iterator for RecordReader<T> {
    type Item = Result<T, FileError>;

    fn next(&mut self) -> Option<Self::Item> {
        let read = Self::read(self.file.as_mut()?);
        if !matches!(read, Ok(Some(_))) {
            self.file = None;
        }
        read.at(&self.path).transpose()
    }
}

fn first_line(kind: &str) -> String {
    format!("v2vloc {kind} 1\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_read_up_to_the_damage() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let records = vec!["one".to_owned(), String::new(), "three".to_owned()];
        let mut writer = RecordWriter::create(&path, "words").unwrap();
        for record in &records {
            writer.add(record).unwrap();
        }
        let reader = RecordReader::<String>::open(&path, "words").unwrap();
        let whole: Result<Vec<_>, _> = reader.collect();
        assert_eq!(whole.unwrap(), records);
        let error = RecordReader::<String>::open(&path, "numbers").unwrap_err();
        let error = error.to_string();
        assert!(error.contains("is no log of numbers"), "{error}");

        let bytes = std::fs::read(&path).unwrap();
        let mut damaged = bytes.clone();
        *damaged.last_mut().unwrap() ^= 1;
        for damaged in [&bytes[..bytes.len() - 1], damaged.as_slice()] {
            std::fs::write(&path, damaged).unwrap();
            let reader = RecordReader::<String>::open(&path, "words").unwrap();
            let read: Vec<_> = reader.collect();
            let (last, first) = read.split_last().unwrap();
            assert!(last.is_err() && first.iter().all(Result::is_ok) && first.len() == 2);
        }
    }
}
