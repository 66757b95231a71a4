//! The format that the program is called after.
#![no_main]

use std::path::Path;
use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use tempfile::TempDir;
use tests::mutation::readers::{Reader, all};

fn reader() -> &'static Reader {
    static READER: OnceLock<(TempDir, Reader)> = OnceLock::new();
    let (_, reader) = READER.get_or_init(|| {
        let scratch = tempfile::tempdir().expect("a temporary folder");
        // Not as it was compiled: fuzz/run compiles it once and calls it by many names.
        let program = std::env::args_os().next().unwrap_or_default();
        let name = Path::new(&program)
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .replace('_', " ");
        let reader = all(scratch.path())
            .into_iter()
            .find(|reader| reader.name == name);
        (
            scratch,
            reader.expect("every target is called after a format"),
        )
    });
    reader
}

fuzz_target!(|bytes: &[u8]| {
    let _ = reader().try_read(bytes);
});
