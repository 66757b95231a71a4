//! Build script: writes the path of libtorch into the run path of every binary, test and benchmark of a package that
//! names this file as its build script, so that none of them needs LD_LIBRARY_PATH. Before it comes the folder `lib` beside
//! that of the programs, where `deploy/install` puts the libraries.

use std::env;

pub(crate) fn main() {
    // No other file is an input; Cargo compiles and runs this script again by itself when it changes.
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    // Set by the build script of torch-sys, however it found libtorch.
    let Ok(lib_dir) = env::var("DEP_TCH_LIBTORCH_LIB") else {
        return;
    };
    println!("cargo:rustc-link-arg=-Wl,-rpath,$ORIGIN/../lib");
    let lib_dir = std::path::absolute(&lib_dir).map_or(lib_dir, |path| path.display().to_string());
    println!("cargo:rustc-link-arg=-Wl,-rpath,{lib_dir}");
}
