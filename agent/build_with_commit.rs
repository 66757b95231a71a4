//! Build script of packages whose results name the commit of the checkout: that, in `V2VLOC_COMMIT`, and the run path
//! of libtorch, as in other packages.

#[path = "build.rs"]
mod run_path;

use std::path::Path;
use std::process::Command;

fn main() {
    run_path::main();
    // It has a line for each change of the checked-out commit.
    let log = git(&["rev-parse", "--git-path", "logs/HEAD"]);
    if let Some(log) = log.filter(|log| Path::new(log).is_file()) {
        println!("cargo:rerun-if-changed={log}");
    }
    let commit = git(&["rev-parse", "--short=12", "HEAD"]);
    println!(
        "cargo:rustc-env=V2VLOC_COMMIT={}",
        commit.as_deref().unwrap_or("unknown")
    );
}

/// Output of git in the folder of the package; `None` outside a checkout.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = output.status.success().then_some(output.stdout)?;
    Some(String::from_utf8(text).ok()?.trim().to_owned())
}
