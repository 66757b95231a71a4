//! Standard output and error of the programs: a reader that closes its end (`| head -1`) ends nothing.
//!
//! `println!` panics where nobody reads any more. What is printed here goes nowhere then, and the program comes to its end
//! with the exit code that it would have had. Other failures, a full disk for example, are errors.

use std::fmt::Display;
use std::io::{self, ErrorKind, Write};

/// Prints a line to standard output.
///
/// # Errors
/// When it cannot be written, and that not because nobody reads any more.
pub fn line(line: impl Display) -> io::Result<()> {
    print(io::stdout().lock(), format_args!("{line}\n"))
}

/// Prints a text, which brings its own line ends, to standard output.
///
/// # Errors
/// As [`line()`].
pub fn text(text: impl Display) -> io::Result<()> {
    print(io::stdout().lock(), text)
}

/// Prints a line to standard error. Where that fails there is no place left to say so.
pub fn note(line: impl Display) {
    let _ = print(io::stderr().lock(), format_args!("{line}\n"));
}

fn print(mut to: impl Write, text: impl Display) -> io::Result<()> {
    match write!(to, "{text}").and_then(|()| to.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        Err(error) => Err(io::Error::new(error.kind(), format!("cannot write to standard output: {error}"))),
        Ok(()) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Takes nothing, for one reason.
    struct Refusing(ErrorKind);

    impl Write for Refusing {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(self.0.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_reader_that_has_gone_is_no_error_and_a_full_disk_is() {
        assert!(print(Refusing(ErrorKind::BrokenPipe), "text").is_ok());
        let error = print(Refusing(ErrorKind::StorageFull), "text").unwrap_err();
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
