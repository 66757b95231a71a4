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
