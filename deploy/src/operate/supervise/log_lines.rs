//! Standard output of a process, its report: copied into the log and passed on line by line.

use std::fs::File;
use std::io::Write;

use tokio::io::{AsyncRead, AsyncReadExt};

/// Longest line, bytes; the rest of a longer one is in the log only.
const MAX_LINE: usize = 64 << 10;

/// Copies all of `output` into `log` and passes its lines, without line ends, to `on_line`.
pub(super) async fn follow(
    mut output: impl AsyncRead + Unpin,
    mut log: File,
    mut on_line: impl FnMut(String),
) {
    let (mut line, mut piece) = (Vec::new(), vec![0; 4096]);
    while let Ok(count @ 1..) = output.read(&mut piece).await {
        let bytes = &piece[..count];
        // A full disk takes no log; the process goes on.
        let _ = log.write_all(bytes);
        for part in bytes.split_inclusive(|byte| *byte == b'\n') {
            // A process without line ends must not fill the memory.
            let room = MAX_LINE.saturating_sub(line.len());
            line.extend_from_slice(&part[..part.len().min(room)]);
            if part.ends_with(b"\n") {
                on_line(String::from_utf8_lossy(&line).trim_end().to_owned());
                line.clear();
            }
        }
    }
    if !line.is_empty() {
        on_line(String::from_utf8_lossy(&line).trim_end().to_owned());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 1)]
    async fn lines_are_passed_on_and_all_is_in_the_log() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let printed = format!("one\ntwo {}\nthree", "x".repeat(MAX_LINE));
        let mut lines = Vec::new();
        follow(printed.as_bytes(), File::create(&path).unwrap(), |line| {
            lines.push(line)
        })
        .await;
        assert_eq!(
            (lines[0].as_str(), lines[1].len(), lines[2].as_str()),
            ("one", MAX_LINE, "three")
        );
        assert_eq!(std::fs::read_to_string(path).unwrap(), printed);
    }
}
