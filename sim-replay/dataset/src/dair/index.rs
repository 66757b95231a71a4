//! Index of DAIR-V2X and V2X-Seq: pairs of frames with time and batch or sequence, from two files `data_info.json`.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Range;
use std::path::Path;

use crate::faults::Faults;
use crate::json::JsonField;
use crate::time_stamps::Unit;
use crate::{ReadError, Result, Tick, json_table};
use support::statistics;

/// The pairs, below the root.
pub(super) const COOPERATIVE: &str = "cooperative/data_info.json";
/// Capture times of the vehicle's frames, below the root.
const CAPTURES: &str = "vehicle-side/data_info.json";
/// Capture times of the roadside unit's frames, below the root.
const UNIT_CAPTURES: &str = "infrastructure-side/data_info.json";
/// Files of the index, below the root.
pub(super) const FILES: [&str; 3] = [COOPERATIVE, CAPTURES, UNIT_CAPTURES];
/// Times between two sweeps that are no pair, seconds. Those published are up to some 50 ms apart. Clocks with other
/// starts or time zones are an hour apart or more, and say nothing of pairs.
const APART_S: Range<f64> = 0.2..3600.0;
/// Median time between the sweeps of pairs that are one frame of 10 Hz apart at least, seconds; published ones differ by
/// less, and the next sweep of a side is 0.1 s away.
const ONE_FRAME_S: f64 = 0.075;
/// Largest `data_info.json` that is read, bytes. Those published have up to 20 MB.
const MAX_BYTES: u64 = 512 << 20;

/// Variant of the data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Dair,
    V2xSeq,
}

impl Kind {
    /// Term for the frames of one drive, and the key of its id.
    fn group(self) -> (&'static str, &'static str) {
        match self {
            Self::Dair => ("batch", "batch_id"),
            Self::V2xSeq => ("sequence", "sequence_id"),
        }
    }
}

/// Two frames that belong together, by their ids.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FramePair {
    pub(super) vehicle: String,
    pub(super) infrastructure: String,
    /// Correction of the roadside unit's position, metres, where the pair states one.
    pub(super) offset_m: Option<[f64; 2]>,
    /// The sequence, where the pair states it.
    sequence: Option<String>,
}

/// Capture time and batch or sequence of a frame of one side.
#[derive(Debug)]
struct Capture {
    /// `None` where the time cannot be read.
    micros: Option<u64>,
    group: Option<String>,
}

/// Captures of one side by the ids of their frames.
type Captures = HashMap<String, Capture>;

/// The pairs of a data set, in the order of their time.
#[derive(Debug)]
pub(super) struct Index {
    pub(super) kind: Kind,
    /// By the name of the batch or sequence.
    pub(super) groups: BTreeMap<String, Vec<(Tick, FramePair)>>,
}

impl Index {
    /// Reads the pairs of `root`. Entries that cannot be used are left out, with a problem each.
    ///
    /// # Errors
    /// If there is no pair at all.
    pub(super) fn read(
        root: &Path,
        period_nanos: u64,
        problems: &mut Vec<ReadError>,
    ) -> Result<Self> {
        let path = root.join(COOPERATIVE);
        let (kind, pairs) = read_pairs(&path, problems)?;
        if pairs.is_empty() {
            let reason =
                "lists no pair of frames of vehicle and roadside unit that can be read (DAIR-V2X)";
            return Err(ReadError::malformed(&path, reason));
        }
        let captures = read_captures(&root.join(CAPTURES), kind, problems);
        // The times of the unit only tell which pairs are none: a data set without them is whole.
        let of_unit = read_captures(&root.join(UNIT_CAPTURES), kind, &mut Vec::new());
        let (mut faults, mut gaps_s) = (Faults::default(), Vec::new());
        let has_times = captures.values().any(|capture| capture.micros.is_some());
        let mut groups: BTreeMap<String, Vec<(u64, FramePair)>> = BTreeMap::new();
        let (noun, _) = kind.group();
        for pair in pairs {
            let times = times_s(&pair, &captures, &of_unit);
            if let Some(reason) = times.and_then(|times_s| apart(&pair, times_s)) {
                faults.push(ReadError::malformed(&path, reason));
                continue;
            }
            gaps_s.extend(times.map(|[time_s, unit_s]| (time_s - unit_s).abs()));
            let capture = captures.get(&pair.vehicle);
            let group = capture.and_then(|capture| capture.group.as_ref());
            let name = match group.or(pair.sequence.as_ref()) {
                Some(group) => format!("{noun}_{group}"),
                None => noun.to_owned(),
            };
            let group = groups.entry(name).or_default();
            // Without any time stamp the order of the list is the best available.
            let in_list = || (group.len() as u64).saturating_mul(period_nanos / 1000);
            let micros = capture.and_then(|capture| capture.micros);
            match micros.or_else(|| (!has_times).then(in_list)) {
                Some(micros) => group.push((micros, pair)),
                None => {
                    let reason = format!("no time stamp of vehicle frame {}", pair.vehicle);
                    faults.push(ReadError::malformed(&root.join(CAPTURES), reason));
                }
            }
        }
        faults.report("pair", problems);
        problems.extend(one_frame_off(&path, &gaps_s));
        let groups = groups.into_iter().filter(|(_, all)| !all.is_empty());
        let groups = groups.map(|(name, all)| (name, in_order(all))).collect();
        Ok(Self { kind, groups })
    }
}

/// The problem that the sweeps of pairs are a frame apart, by the times between those of each pair, seconds.
fn one_frame_off(path: &Path, gaps_s: &[f64]) -> Option<ReadError> {
    let gap_s = statistics::median(gaps_s)?;
    (ONE_FRAME_S..APART_S.end).contains(&gap_s).then(|| {
        let reason = format!(
            "the frames of a pair are {gap_s:.3} s apart in the median, expected less than {ONE_FRAME_S} s: pairs one \
             frame off, or clocks that differ"
        );
        ReadError::malformed(path, reason)
    })
}

/// Times of vehicle and unit of a pair, seconds, where both are known.
fn times_s(pair: &FramePair, captures: &Captures, of_unit: &Captures) -> Option<[f64; 2]> {
    let time_s = |captures: &Captures, id: &str| Some(captures.get(id)?.micros? as f64 * 1e-6);
    let unit_s = time_s(of_unit, &pair.infrastructure)?;
    Some([time_s(captures, &pair.vehicle)?, unit_s])
}

/// The reason why the frames of a pair are not of one time.
fn apart(pair: &FramePair, [time_s, unit_s]: [f64; 2]) -> Option<String> {
    let [vehicle, unit] = [&pair.vehicle, &pair.infrastructure];
    APART_S.contains(&(time_s - unit_s).abs()).then(|| {
        format!(
            "vehicle frame {vehicle} at {time_s:.3} s with frame {unit} of the unit at {unit_s:.3} s, expected at \
             most {} s apart",
            APART_S.start
        )
    })
}

/// Ticks by time, from the first on.
fn in_order(mut pairs: Vec<(u64, FramePair)>) -> Vec<(Tick, FramePair)> {
    pairs.sort_by(|(a, first), (b, second)| (a, &first.vehicle).cmp(&(b, &second.vehicle)));
    let start = pairs.first().map_or(0, |(micros, _)| *micros);
    let ticks = pairs.into_iter().map(|(micros, pair)| {
        let capture_nanos = (micros - start).saturating_mul(1000);
        (Tick::new(pair.vehicle.clone(), capture_nanos), pair)
    });
    ticks.collect()
}

fn read_pairs(path: &Path, problems: &mut Vec<ReadError>) -> Result<(Kind, Vec<FramePair>)> {
    let mut kind = None;
    let mut pairs: Vec<FramePair> = Vec::new();
    let mut seen = HashSet::new();
    json_table::read_all(path, MAX_BYTES, problems, |entry| {
        let pair = pair(entry, &mut kind)?;
        let vehicle = &pair.vehicle;
        if !seen.insert(vehicle.clone()) {
            return Err(entry.error(format!("vehicle frame {vehicle} is in a pair already")));
        }
        pairs.push(pair);
        Ok(())
    })?;
    Ok((kind.unwrap_or(Kind::Dair), pairs))
}

/// The first entry decides which of the two data sets it is.
fn pair(entry: &JsonField<'_>, kind: &mut Option<Kind>) -> Result<FramePair> {
    let is_sequence = entry.optional("vehicle_frame")?.is_some();
    let kind = *kind.get_or_insert(match is_sequence {
        true => Kind::V2xSeq,
        false => Kind::Dair,
    });
    Ok(FramePair {
        vehicle: id_of_side(entry, kind, "vehicle")?,
        infrastructure: id_of_side(entry, kind, "infrastructure")?,
        offset_m: entry.optional_of("system_error_offset", offset_m)?,
        sequence: entry.optional_of("vehicle_sequence", frame_id)?,
    })
}

fn id_of_side(pair: &JsonField<'_>, kind: Kind, side: &str) -> Result<String> {
    if kind == Kind::V2xSeq {
        return frame_id(&pair.required(&format!("{side}_frame"))?);
    }
    let points = format!("{side}_pointcloud_path");
    match pair.optional(&format!("{side}_image_path"))? {
        // Points are read by the same id.
        Some(image) if pair.optional(&points)?.is_none() => stem(&image),
        _ => stem(&pair.required(&points)?),
    }
}

/// The id of a frame: the name of its files without suffix.
fn stem(path: &JsonField<'_>) -> Result<String> {
    let text = path.text()?;
    let name = text.rsplit(['/', '\\']).next().unwrap_or(text);
    checked_id(path, name.rsplit_once('.').map_or(name, |(stem, _)| stem))
}

fn frame_id(field: &JsonField<'_>) -> Result<String> {
    checked_id(field, &field.id()?)
}

/// Ids become names of files.
fn checked_id(field: &JsonField<'_>, id: &str) -> Result<String> {
    let mut letters = id.chars();
    if id.is_empty()
        || id.len() > 64
        || !letters.all(|letter| letter.is_ascii_alphanumeric() || matches!(letter, '_' | '-'))
    {
        let shown: String = id.chars().take(40).collect();
        return Err(field.error(format!(
            "{shown:?} is no id of a frame: expected up to 64 letters, digits, _ and -"
        )));
    }
    Ok(id.to_owned())
}

/// Captures of a side by frame id. Entries that cannot be read are left out, with a problem; of entries without a
/// readable time stamp the batch or sequence is kept.
fn read_captures(path: &Path, kind: Kind, problems: &mut Vec<ReadError>) -> Captures {
    let (mut stamps, mut faults, mut groups) = (HashMap::new(), Faults::default(), Vec::new());
    let (_, group_key) = kind.group();
    let read = json_table::read_all(path, MAX_BYTES, problems, |entry| {
        let id = match entry.optional("frame_id")? {
            Some(id) => frame_id(&id)?,
            None => stem(&entry.required("pointcloud_path")?)?,
        };
        let group = entry.optional_of(group_key, frame_id)?;
        let stamp = entry.required("pointcloud_timestamp");
        if let Some(stamp) = faults.take(stamp.and_then(|stamp| stamp.time())) {
            stamps.insert(id.clone(), stamp);
        }
        groups.push((id, group));
        Ok(())
    });
    problems.extend(read.err());
    faults.report("time stamp", problems);
    if stamps.is_empty() {
        let reason = "no time stamps: frames are taken as evenly spaced, in the order of the pairs";
        problems.push(ReadError::malformed(path, reason));
    }
    let in_order = statistics::sorted(&stamps.values().copied().collect::<Vec<f64>>());
    let unit = Unit::of_file(path, &in_order, problems);
    let captures = groups.into_iter().map(|(id, group)| {
        let stamp = stamps.get(&id);
        let micros = stamp.map(|&stamp| unit.micros(stamp));
        (id, Capture { micros, group })
    });
    captures.collect()
}

/// `{delta_x, delta_y}` in metres. A missing one or an empty text is 0.
pub(super) fn offset_m(offset: &JsonField<'_>) -> Result<[f64; 2]> {
    let [x, y] = ["delta_x", "delta_y"].map(|key| offset.optional_of(key, JsonField::number));
    Ok([x?.unwrap_or(0.0), y?.unwrap_or(0.0)])
}
