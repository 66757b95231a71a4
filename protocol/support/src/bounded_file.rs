//! Whole files of a bounded size: a file of gigabytes must not fill the memory, and a pipe or device not block or never
//! end.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// Largest text of settings, keys or results that is read, bytes.
pub const MAX_TEXT_BYTES: u64 = 64 << 20;

/// Largest number of bytes that a compressed file may unpack to: recorded data shrink to a tenth, constant ones to some
/// hundredth.
pub fn most_unpacked(packed_bytes: u64) -> u64 {
    packed_bytes.saturating_mul(300).saturating_add(64 << 20)
}

/// Opens a file for reading.
///
/// # Errors
/// The error of the system, and [`io::ErrorKind::InvalidInput`] for a pipe, socket or device.
pub fn open(path: &Path) -> io::Result<File> {
    // Asked before: opening a pipe waits for its other end.
    let kind = std::fs::metadata(path)?.file_type();
    if !kind.is_file() && !kind.is_dir() {
        let reason = "no regular file: pipes, sockets and devices are not read";
        return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
    }
    File::open(path)
}

/// Reads a file of at most `max_bytes`.
///
/// # Errors
/// Those of [`open`], and [`io::ErrorKind::FileTooLarge`] for a larger file.
pub fn read(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let file = open(path)?;
    let stated = file.metadata()?.len();
    let mut bytes = Vec::with_capacity(usize::try_from(stated.min(max_bytes)).unwrap_or(0));
    // One byte more than the limit shows a larger file: the stated size may be out of date.
    file.take(max_bytes.saturating_add(1))
        .read_to_end(&mut bytes)?;
    if bytes.len() as u64 > max_bytes {
        let reason = format!("larger than {max_bytes} bytes, the most that is read");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, reason));
    }
    Ok(bytes)
}

/// Reads a text file of at most `max_bytes`.
///
/// # Errors
/// As [`read`], and [`io::ErrorKind::InvalidData`] when it is not UTF-8.
pub fn read_text(path: &Path, max_bytes: u64) -> io::Result<String> {
    String::from_utf8(read(path, max_bytes)?)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_and_pipes_are_refused_without_waiting_for_them() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        for path in [Path::new("/dev/zero"), &pipe] {
            let error = read(path, u64::MAX).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::InvalidInput, "{error}");
        }
        assert_eq!(
            read(Path::new("/dev/null"), 9).unwrap_err().kind(),
            io::ErrorKind::InvalidInput
        );
    }

    #[test]
    fn a_file_that_is_too_large_is_refused_and_one_of_the_size_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::write(&path, "0123456789").unwrap();
        assert_eq!(read_text(&path, 10).unwrap(), "0123456789");
        assert_eq!(
            read(&path, 9).unwrap_err().kind(),
            io::ErrorKind::FileTooLarge
        );
        std::fs::write(&path, [0xff]).unwrap();
        assert_eq!(
            read_text(&path, 9).unwrap_err().kind(),
            io::ErrorKind::InvalidData
        );
    }
}
