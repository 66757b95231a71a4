//! Long run of damaged inputs: `cargo bench -p tests --bench mutation -- [MESSAGES] [FILES] [SEED]`, by default ten
//! million messages and a million files of each format; prints a table. With `-- --seeds FOLDER` it writes the valid
//! inputs instead, for `fuzz/`.

use peak_alloc::PeakAlloc;
use tests::mutation::run::{files, formats, messages};
use tests::mutation::scratch;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

fn main() {
    let numbers: Vec<u64> = std::env::args()
        .skip(1)
        .filter_map(|argument| argument.parse().ok())
        .collect();
    let number = |place: usize, usual| numbers.get(place).copied().unwrap_or(usual);
    let (of_messages, of_files, seed) = (number(0, 10_000_000), number(1, 1_000_000), number(2, 7));
    let scratch = scratch();
    let folder = std::env::args()
        .skip_while(|argument| argument != "--seeds")
        .nth(1);
    if let Some(folder) = folder {
        return write_seeds(folder.as_ref(), formats(scratch.path()));
    }
    println!("| format | damaged | accepted | panics | peak memory of one, KiB | seconds |");
    println!("| --- | --- | --- | --- | --- | --- |");
    let message_report = (of_messages > 0).then(|| messages(of_messages, seed, &MEMORY));
    let read = (of_files > 0).then(|| files(scratch.path(), of_files, seed, &MEMORY));
    for report in message_report.into_iter().chain(read.into_iter().flatten()) {
        let (kib, seconds) = (report.peak_bytes.div_ceil(1024), report.took.as_secs());
        println!(
            "| {} | {} | {} | {} | {kib} | {seconds} |",
            report.name,
            report.cases,
            report.accepted,
            report.panics.len()
        );
    }
}

/// A folder for each format, a file for each valid input.
fn write_seeds(folder: &std::path::Path, formats: Vec<(&str, Vec<Vec<u8>>)>) {
    for (name, seeds) in formats {
        let folder = folder.join(name.replace(' ', "_"));
        std::fs::create_dir_all(&folder).expect("a writable folder");
        for (number, seed) in seeds.iter().enumerate() {
            std::fs::write(folder.join(format!("{number:02}")), seed).expect("a writable folder");
        }
    }
}
