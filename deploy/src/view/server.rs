//! Web server of the page and of its data.

use std::collections::BTreeSet;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use bus::web::{Answer, Request, WebServer};
use bytes::Bytes;
use protocol::{CavId, ImageFormat};
use recording::RecordingError;
use serde_json::json;

use super::heat_map::HeatMap;
use super::live::Image;
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
            let limit = text_of("frames", &request.query).and_then(|limit| limit.parse().ok());
            let frames = run.moments(limit, ego_of(&request.query));
            Answer::Stream {
                content_type: BINARY,
                pieces: frames,
            }
        }
        "/status" => document(&json!(run.status())),
        path => match (camera(path), mapped(path)) {
            (Some(camera), _) => image(run.shared.images.get(&camera)),
            (None, Some(cav)) => {
                let message = run.shared.maps.get(&cav);
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
        recorded(&run, request).unwrap_or_else(Answer::NotFound)
    })
}

/// Answer of a recorded run.
///
/// # Errors
/// The text of a 404: the egos, vehicles or moments of the recording.
fn recorded(run: &RecordedRun, request: &Request) -> Result<Answer, String> {
    let (path, query) = (request.path.as_str(), request.query.as_str());
    let ego = ego_of(query);
    if path == "/run" {
        // Of an ego without results those of the first one: the page goes on with that.
        let (timeline, cameras) = (run.timeline(ego.as_ref()), run.cameras());
        let about = json!({"mode": "recorded", "run": run.name(), "timeline": timeline,
            "cameras": cameras, "egos": Vec::from_iter(run.egos())});
        return Ok(document(&about));
    }
    let no_answer = |error: RecordingError| error.to_string();
    let (pictured, mapped) = (camera(path), mapped(path));
    let vehicle = pictured.as_ref().map(|(cav, _)| cav).or(mapped.as_ref());
    if let Some(cav) = vehicle {
        let publishers = run.streams().map(|(cav, _)| cav);
        check_known("vehicle", cav.as_str(), publishers)?;
        let index = moment(text_of("at", query).unwrap_or("0"), run)?;
        let found = match pictured {
            Some((_, number)) => run.image(index, cav, number).map(image),
            None => run.heat_map(index, cav).map(heat_map),
        };
        return found.map_err(no_answer);
    }
    let Some(index) = path.strip_prefix("/frame/") else {
        return Ok(asset(request));
    };
    if let Some(asked) = text_of("ego", query) {
        check_known("ego", asked, run.egos())?;
    }
    let frame = run.frame(moment(index, run)?, ego.as_ref());
    let frame = frame.map_err(no_answer)?.ok_or("nothing is shown here")?;
    Ok(page(BINARY, frame.to_bytes()))
}

/// Refuses an id that is none of those known.
fn check_known<'a>(
    kind: &str,
    asked: &str,
    mut known: impl Iterator<Item = &'a CavId> + Clone,
) -> Result<(), String> {
    let all = known.clone();
    if known.any(|id| id.as_str() == asked) {
        return Ok(());
    }
    let all: BTreeSet<&str> = all.map(CavId::as_str).collect();
    Err(format!("there is no {kind} {asked:?}, only {all:?}"))
}

/// Index of a moment of a run.
fn moment(text: &str, run: &RecordedRun) -> Result<usize, String> {
    let (index, count) = (text.parse::<usize>().ok(), run.count());
    let index = index.filter(|index| *index < count);
    index.ok_or_else(|| format!("there is no moment {text:?}, only {count}, counted from 0"))
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

fn image(found: Option<Image>) -> Answer {
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
