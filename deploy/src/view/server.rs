//! Web server of the page and of its data.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use bus::web::{Answer, Request, WebServer};
use bytes::Bytes;
use futures_util::StreamExt;
use protocol::{CavId, ImageFormat};
use recording::RecordingError;
use serde_json::json;

use super::heat_map::HeatMap;
use super::{LiveRun, RecordedRun};

const HTML: &str = include_str!("page/index.html");
const STYLE: &str = include_str!("page/style.css");
/// Scripts, in the order in which the page loads them.
const SCRIPTS: [(&str, &str); 6] = [
    ("/view.js", include_str!("page/view.js")),
    ("/panels.js", include_str!("page/panels.js")),
    ("/series.js", include_str!("page/series.js")),
    ("/heat.js", include_str!("page/heat.js")),
    ("/scene.js", include_str!("page/scene.js")),
    ("/moments.js", include_str!("page/moments.js")),
];

/// Content type of scene frames.
const BINARY: &str = "application/octet-stream";

/// Shown where there is no image: live until the first one of a camera has arrived, which is received once a page asks
/// for it; recorded where none was captured.
const NO_IMAGE: &str = r#"<svg xmlns="http://www.w3.org/2000/svg" width="16" height="10"/>"#;

/// Serves the page of a live run until dropped.
///
/// # Errors
/// [`io::Error`] when the address cannot be listened at.
pub fn serve_live(address: SocketAddr, run: Arc<LiveRun>) -> io::Result<WebServer> {
    WebServer::start(address, move |request| match request.path.as_str() {
        "/run" => document(&json!({"mode": "live", "run": run.name()})),
        "/live" => {
            let frames = run.moments(number_of("frames", &request.query), ego_of(&request.query));
            Answer::Stream {
                content_type: BINARY,
                pieces: frames.boxed(),
            }
        }
        "/status" => document(&json!(run.status())),
        path => match (camera(path), mapped(path)) {
            (Some(camera), _) => image(run.images().get(&camera)),
            (None, Some(cav)) => {
                let message = run.maps().get(&cav);
                heat_map(message.and_then(|message| HeatMap::of(&message)))
            }
            (None, None) => asset(request),
        },
    })
}

/// Serves the page of a recorded run until dropped.
///
/// # Errors
/// [`io::Error`] when the address cannot be listened at.
pub fn serve_recorded(address: SocketAddr, run: Arc<RecordedRun>) -> io::Result<WebServer> {
    WebServer::start(address, move |request| {
        let ego = ego_of(&request.query);
        if request.path == "/run" {
            let timeline = run.timeline(ego.as_ref());
            let (egos, cameras) = (run.egos(), run.cameras());
            return document(&json!({"mode": "recorded", "run": run.name(), "egos": egos,
                "timeline": timeline, "cameras": cameras}));
        }
        let index = number_of("at", &request.query).unwrap_or(0) as usize;
        if let Some((cav, number)) = camera(&request.path) {
            return run.image(index, &cav, number).map_or_else(not_found, image);
        }
        if let Some(cav) = mapped(&request.path) {
            return run.heat_map(index, &cav).map_or_else(not_found, heat_map);
        }
        let Some(index) = request.path.strip_prefix("/frame/") else {
            return asset(request);
        };
        match index.parse().map(|index| run.frame(index, ego.as_ref())) {
            Ok(Ok(Some(frame))) => page(BINARY, frame.to_bytes()),
            Ok(Ok(None)) => {
                Answer::NotFound(format!("there are {} moments, counted from 0", run.len()))
            }
            Ok(Err(error)) => not_found(error),
            Err(error) => Answer::NotFound(format!("{index:?} is no number: {error}")),
        }
    })
}

/// Vehicle and number of `/camera/<cav>/<number>`.
fn camera(path: &str) -> Option<(CavId, u8)> {
    let (cav, number) = path.strip_prefix("/camera/")?.split_once('/')?;
    Some((CavId::new(cav).ok()?, number.parse().ok()?))
}

/// Vehicle of `/map/<cav>`.
fn mapped(path: &str) -> Option<CavId> {
    CavId::new(path.strip_prefix("/map/")?).ok()
}

/// A heat map; nothing where there is none.
fn heat_map(found: Option<HeatMap>) -> Answer {
    page(BINARY, found.map_or(Vec::new(), |map| map.to_bytes()))
}

#[expect(clippy::needless_pass_by_value, reason = "the error of a result")]
fn not_found(error: RecordingError) -> Answer {
    Answer::NotFound(error.to_string())
}

fn image(found: Option<(ImageFormat, Bytes)>) -> Answer {
    match found {
        Some((ImageFormat::Png, image)) => page("image/png", image),
        Some((ImageFormat::Jpeg, image)) => page("image/jpeg", image),
        None => page("image/svg+xml", NO_IMAGE),
    }
}

fn page(content_type: &'static str, body: impl Into<Bytes>) -> Answer {
    Answer::Page {
        content_type,
        body: body.into(),
    }
}

fn asset(request: &Request) -> Answer {
    let script = SCRIPTS.into_iter().find(|(path, _)| *path == request.path);
    let (content_type, text) = match (request.path.as_str(), script) {
        ("/", _) => ("text/html; charset=utf-8", HTML),
        ("/style.css", _) => ("text/css; charset=utf-8", STYLE),
        (_, Some((_, script))) => ("text/javascript; charset=utf-8", script),
        (other, None) => return Answer::NotFound(format!("there is no {other}")),
    };
    page(content_type, text)
}

fn document(value: &serde_json::Value) -> Answer {
    page("application/json", value.to_string())
}

/// Number that a query has for `name`.
fn number_of(name: &str, query: &str) -> Option<u64> {
    text_of(name, query)?.parse().ok()
}

/// Ego whose results are asked for.
fn ego_of(query: &str) -> Option<CavId> {
    CavId::new(text_of("ego", query)?).ok()
}

fn text_of<'a>(name: &str, query: &'a str) -> Option<&'a str> {
    // Values are not percent-decoded: ids and numbers need no escapes.
    query
        .split('&')
        .find_map(|pair| pair.strip_prefix(name)?.strip_prefix('='))
}
