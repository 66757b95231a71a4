//! Exit of a program: printed errors, and the exit codes 0 to 3 and 130.

use std::error::Error;
use std::fmt::{Debug, Display};
use std::io;
use std::path::PathBuf;
use std::process::ExitCode;

use crate::file_error::NoSpace;
use crate::output;

/// Error of usage or input, not of the program: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct BadInput(anyhow::Error);

impl BadInput {
    /// An error with its causes.
    pub fn of(error: impl Into<anyhow::Error>) -> Self {
        Self(error.into())
    }

    /// An error from a message.
    pub fn new(message: impl Display + Debug + Send + Sync + 'static) -> Self {
        Self(anyhow::Error::msg(message))
    }
}

/// Context of an error of writing: the place that cannot be written. No input causes it: exit code 1, also below
/// [`BadInput`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{} cannot be written", .0.display())]
pub struct NotWritten(pub PathBuf);

/// Cause of an end on request (Ctrl-C): exit code 130. The error above it states what is kept; it is printed as a note.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped")]
pub struct Interrupted;

impl Interrupted {
    /// Exit code: 128 and the number of SIGINT, as of a shell.
    pub const EXIT_CODE: u8 = 130;
}

/// Outcome of a command that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Success: exit code 0.
    Done,
    /// The input is wrong; the errors are printed already: exit code 2.
    BadInput,
    /// Finished, but data were left out or lost: exit code 3.
    DataLost,
}

impl Outcome {
    /// Prints an error of the input.
    pub fn bad_input(error: &dyn Display) -> Self {
        output::error(error);
        Self::BadInput
    }

    /// [`Self::DataLost`] if data were lost.
    pub fn of(lost_data: bool) -> Self {
        match lost_data {
            true => Self::DataLost,
            false => Self::Done,
        }
    }
}

/// Exit code of a command; prints the chain of causes of an error. `is_bad_input` recognises causes that are errors of
/// the input, in addition to [`BadInput`].
pub fn exit_code(
    result: anyhow::Result<Outcome>,
    is_bad_input: impl Fn(&(dyn Error + 'static)) -> bool,
) -> ExitCode {
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::BadInput) => ExitCode::from(2),
        Ok(Outcome::DataLost) => ExitCode::from(3),
        Err(error) if error.chain().any(|cause| cause.is::<Interrupted>()) => {
            output::note(chain_of(&error));
            ExitCode::from(Interrupted::EXIT_CODE)
        }
        Err(error) => {
            output::error(chain_of(&error));
            let mut causes = error.chain();
            let is_bad = causes.any(|cause| cause.is::<BadInput>() || is_bad_input(cause));
            let is_of_input = is_bad && !is_of_writing(&error);
            ExitCode::from(if is_of_input { 2 } else { 1 })
        }
    }
}

/// True for a place that cannot be written, and for a full disk or quota, which no input causes.
fn is_of_writing(error: &anyhow::Error) -> bool {
    let mut causes = error.chain();
    error.is::<NotWritten>()
        || causes.any(|cause| match cause.downcast_ref() {
            // `BadInput` is transparent: the chain of causes skips its inner error, which is looked at here.
            Some(BadInput(inner)) => is_of_writing(inner),
            None => {
                let of_system = cause.downcast_ref::<io::Error>();
                cause.is::<NoSpace>() || of_system.is_some_and(|error| NoSpace::of(error).is_some())
            }
        })
}

/// The chain of causes on one line, without causes that the message above them quotes already.
fn chain_of(error: &anyhow::Error) -> String {
    error.chain().fold(String::new(), |text, cause| {
        let cause = cause.to_string();
        match text.as_str() {
            "" => cause,
            above if above.contains(&cause) => text,
            above => format!("{above}: {cause}"),
        }
    })
}

#[cfg(test)]
mod tests {
    use std::io::ErrorKind;
    use std::path::Path;

    use anyhow::Context;

    use super::*;
    use crate::file_error::AtFile;

    fn code_of(result: anyhow::Result<Outcome>) -> ExitCode {
        exit_code(result, |cause| cause.is::<std::num::ParseIntError>())
    }

    fn io_error(kind: ErrorKind) -> anyhow::Error {
        anyhow::Error::from(io::Error::from(kind))
    }

    #[test]
    fn exit_codes_are_0_to_3_and_130() {
        for (outcome, code) in [
            (Outcome::Done, 0),
            (Outcome::BadInput, 2),
            (Outcome::DataLost, 3),
        ] {
            assert_eq!(code_of(Ok(outcome)), ExitCode::from(code));
        }
        assert_eq!(
            (Outcome::of(false), Outcome::of(true)),
            (Outcome::Done, Outcome::DataLost)
        );
        assert_eq!(code_of(Err(anyhow::anyhow!("broken"))), ExitCode::from(1));
        assert_eq!(
            code_of(Err(
                anyhow::anyhow!(Interrupted).context("stopped at step 3")
            )),
            ExitCode::from(130)
        );
        let bad: anyhow::Result<Outcome> = Err(BadInput::new("--frames is 0").into());
        assert_eq!(code_of(bad.context("reading")), ExitCode::from(2));
        let bad = "x"
            .parse::<i32>()
            .context("--frames")
            .map(|_| Outcome::Done);
        assert_eq!(code_of(bad), ExitCode::from(2));
    }

    #[test]
    fn a_full_disk_is_no_bad_input_wherever_it_is_found() {
        let of_file =
            Err::<(), _>(io::Error::from(ErrorKind::StorageFull)).at(Path::new("out/maps"));
        let full = io_error(ErrorKind::StorageFull).context("out/frames.csv");
        let not_written = io_error(ErrorKind::NotFound).context(NotWritten("out".into()));
        for error in [
            BadInput::of(io_error(ErrorKind::StorageFull)).into(),
            anyhow::Error::from(BadInput::of(full)).context("max"),
            BadInput::of(of_file.unwrap_err()).into(),
            BadInput::of(not_written.context("max")).into(),
        ] {
            assert_eq!(code_of(Err(error)), ExitCode::from(1));
        }
        let taken = io::Error::from(ErrorKind::AlreadyExists);
        assert_eq!(code_of(Err(BadInput::of(taken).into())), ExitCode::from(2));
    }

    #[test]
    fn a_cause_that_is_quoted_is_printed_once() {
        let error = anyhow::anyhow!("no such file")
            .context("a.yaml: no such file")
            .context("scenario");
        assert_eq!(chain_of(&error), "scenario: a.yaml: no such file");
        let error = BadInput::of(anyhow::anyhow!("inner").context("outer"));
        assert_eq!(chain_of(&error.into()), "outer: inner");
    }
}
