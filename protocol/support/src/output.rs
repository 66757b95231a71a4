//! Standard output and error of the programs: a reader that closes its end (`| head -1`) is no error.
//!
//! `println!` panics if the reader has closed its end. These functions discard the text then, and the program ends with
//! its usual exit code. Other failures, a full disk for example, are errors.

use std::fmt::Display;
use std::io::{self, ErrorKind, Write};
use std::sync::Mutex;

use crate::sync::lock;

/// Verbosity of a program on standard error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verbosity {
    /// Errors only.
    Quiet,
    /// Notes, progress and warnings.
    Usual,
    /// The log of the project's own crates at `debug` too.
    Debug,
    /// The same at `trace`.
    Trace,
}

static VERBOSITY: Mutex<Verbosity> = Mutex::new(Verbosity::Usual);

/// Sets the verbosity of this process.
pub fn set_verbosity(verbosity: Verbosity) {
    *lock(&VERBOSITY) = verbosity;
}

/// The verbosity of this process.
pub fn verbosity() -> Verbosity {
    *lock(&VERBOSITY)
}

/// Prints a line to standard output.
///
/// # Errors
/// When the line cannot be written for another reason than a closed reader.
pub fn line(line: impl Display) -> io::Result<()> {
    print(io::stdout().lock(), format_args!("{line}\n"))
}

/// Prints a text with its own line ends to standard output.
///
/// # Errors
/// As [`line()`].
pub fn text(text: impl Display) -> io::Result<()> {
    print(io::stdout().lock(), text)
}

/// Prints a line to standard error, unless that is quiet. A failure cannot be reported and is ignored.
pub fn note(line: impl Display) {
    if verbosity() > Verbosity::Quiet {
        let _ = print(io::stderr().lock(), format_args!("{line}\n"));
    }
}

/// Prints an error to standard error, also where that is quiet.
pub fn error(line: impl Display) {
    let _ = print(io::stderr().lock(), format_args!("error: {line}\n"));
}

fn print(mut to: impl Write, text: impl Display) -> io::Result<()> {
    match write!(to, "{text}").and_then(|()| to.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        Err(error) => {
            let message = format!("cannot write to standard output: {error}");
            Err(io::Error::new(error.kind(), message))
        }
        Ok(()) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rejects every write with one error.
    struct FailingWriter(ErrorKind);

    impl Write for FailingWriter {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(self.0.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_closed_reader_is_no_error_and_a_full_disk_is() {
        assert!(print(FailingWriter(ErrorKind::BrokenPipe), "text").is_ok());
        let error = print(FailingWriter(ErrorKind::StorageFull), "text").unwrap_err();
        assert_eq!(error.kind(), ErrorKind::StorageFull);
        assert!(error.to_string().contains("standard output"), "{error}");
    }

    #[test]
    fn a_text_is_printed_as_it_is() {
        let mut printed = Vec::new();
        print(&mut printed, format_args!("{} of {}\n", 1, 2)).unwrap();
        assert_eq!(printed, b"1 of 2\n");
    }
}
