//! Where the chunks of a recording go.

use std::fs::File;
use std::io::{self, Write};

/// A place that takes bytes one after the other and can forget the last of them.
pub trait Store: Write {
    /// Forgets everything behind the first `len` bytes.
    ///
    /// # Errors
    /// As the system says.
    fn cut(&mut self, len: u64) -> io::Result<()>;
}

impl Store for File {
    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.set_len(len)
    }
}

/// Keeps what is written until it is flushed, which is at the end of a chunk, and takes away again what the store took only
/// a part of: a full disk ends a recording, but never in the middle of something. Nothing is taken after a failure.
pub(super) struct WholeChunks<S> {
    store: S,
    pending: Vec<u8>,
    /// Bytes that the store has taken.
    whole: u64,
    has_failed: bool,
}

impl<S> WholeChunks<S> {
    pub(super) fn new(store: S) -> Self {
        Self { store, pending: Vec::new(), whole: 0, has_failed: false }
    }

    fn check(&self) -> io::Result<()> {
        if self.has_failed { Err(io::Error::other("writing has failed before")) } else { Ok(()) }
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
        let taken = self.store.write_all(&self.pending).and_then(|()| self.store.flush());
        if taken.is_ok() {
            self.whole += self.pending.len() as u64;
        } else {
            self.has_failed = true;
            if let Err(error) = self.store.cut(self.whole) {
                tracing::error!("what was begun of a recording cannot be taken away: {error}");
            }
        }
        self.pending.clear();
        taken
    }
}
