//! Output of a recording: complete chunks only.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

/// An output that appends bytes and can truncate them.
pub trait Store: Write {
    /// Truncates the output to the first `len` bytes.
    ///
    /// # Errors
    /// Errors of the operating system.
    fn cut(&mut self, len: u64) -> io::Result<()>;

    /// Returns when the output of this name is on the disk.
    ///
    /// # Errors
    /// Errors of the operating system.
    fn sync(_path: &Path) -> io::Result<()> {
        Ok(())
    }
}

impl Store for File {
    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.set_len(len)
    }

    fn sync(path: &Path) -> io::Result<()> {
        support::atomic_file::sync(path)
    }
}

/// Buffers written bytes until a flush, which is at the end of a chunk, and removes what the output took only partly: a
/// full disk ends a recording, but never within a chunk. Nothing is written after a failure.
pub(super) struct WholeChunks<S> {
    store: S,
    pending: Vec<u8>,
    /// Number of bytes in the output.
    whole: u64,
    has_failed: bool,
}

impl<S> WholeChunks<S> {
    pub(super) fn new(store: S) -> Self {
        Self {
            store,
            pending: Vec::new(),
            whole: 0,
            has_failed: false,
        }
    }

    fn check(&self) -> io::Result<()> {
        match self.has_failed {
            true => Err(io::Error::other("writing has failed before")),
            false => Ok(()),
        }
    }
}

impl<S: Store> Write for WholeChunks<S> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.check()?;
        self.pending.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.check()?;
        let written = self.store.write_all(&self.pending);
        let taken = written.and_then(|()| self.store.flush());
        if taken.is_ok() {
            self.whole += self.pending.len() as u64;
        } else {
            self.has_failed = true;
            if let Err(error) = self.store.cut(self.whole) {
                tracing::error!("an incomplete chunk of a recording cannot be removed: {error}");
            }
        }
        self.pending.clear();
        taken
    }
}
