//! Page on a terminal: served until Ctrl-C.

use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::web::WebServer;
use support::cli::BadInput;
use support::output;

use super::recorded::{RecordedRun, ViewError};
use super::server::serve_recorded;

/// Shows a recording until Ctrl-C.
///
/// # Errors
/// When the recording cannot be read, or the address cannot be listened at.
pub fn show_recorded(recording: &Path, listen: SocketAddr) -> anyhow::Result<()> {
    let run = RecordedRun::open(recording).map_err(|error| match error {
        ViewError::Recording(_) => anyhow::Error::from(error),
        _ => BadInput::of(error).into(),
    })?;
    let (count, name) = (run.count(), run.name());
    output::note(format_args!("{count} moments of run {name}"));
    until_stopped(listen, |address| serve_recorded(address, Arc::new(run)))
}

/// Serves a page at `listen` until Ctrl-C.
///
/// # Errors
/// When the address cannot be listened at, or signals cannot be caught.
pub fn until_stopped(
    listen: SocketAddr,
    serve: impl FnOnce(SocketAddr) -> io::Result<WebServer>,
) -> anyhow::Result<()> {
    let stop = Stop::new();
    stop.on_signals()?;
    let server = serve(listen).map_err(|error| {
        BadInput::new(format!(
            "cannot serve at {listen}: {error}; choose another one with --page"
        ))
    })?;
    let address = server.address();
    output::note(format_args!("http://{address}/ (Ctrl-C ends it)"));
    // The wait needs a deadline, the loop makes it endless.
    while !stop.wait_until(Instant::now() + Duration::from_secs(3600)) {}
    let dropped = server.readers().dropped();
    if dropped > 0 {
        output::note(format_args!(
            "{dropped} readers did not read and were dropped"
        ));
    }
    Ok(())
}
