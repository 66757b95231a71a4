//! Reader of `sensor_msgs/PointCloud2`: sweeps as the drivers of LiDARs publish them.
//!
//! Read are `x`, `y`, `z` of 32 or 64 bits and an intensity of any type, by any of its usual names or as the red byte of
//! a packed colour, in any order, at any offset, of either byte order, with padding after points and rows, in one row or
//! in many (organised). Points without coordinates, as organised clouds
//! have them for rays without a return, are left out.

use protocol::text::excerpt;
use protocol::{COLOUR_FIELDS, INTENSITY_FIELDS, IntensityKind, Limits, PointCloud};
use re_cdr::{BigEndian, ByteOrder, LittleEndian};

use crate::read::{ReadError, Reader};

/// More fields than any driver publishes.
const MAX_FIELDS: u32 = 256;

/// A sweep of a LiDAR.
#[derive(Debug, Clone, PartialEq)]
pub struct RosSweep {
    /// Capture time: stamp of the header, nanoseconds.
    pub capture_nanos: u64,
    /// Frame of the points, as the driver names it.
    pub frame_id: String,
    /// Points in the frame of the LiDAR, metres; intensity as published, 0 where there is none.
    pub points: PointCloud,
    /// Name of the field of the intensity and the type of its numbers; `None` if there is none.
    pub intensity: Option<(String, IntensityKind)>,
    /// Points without coordinates (NaN or infinite), which are left out.
    pub without_return: usize,
    /// Points that are farther away than the limit, which are left out.
    pub too_far: usize,
}

/// Reads a `sensor_msgs/PointCloud2` in CDR, with its encapsulation header. No more memory is allocated than the message
/// has bytes for. Of the limits those of points count, points without return included, and of the largest absolute
/// coordinate and intensity.
///
/// # Errors
/// [`ReadError`] names the field and both values.
pub fn read_point_cloud(bytes: &[u8], limits: &Limits) -> Result<RosSweep, ReadError> {
    let mut message = Reader::of(bytes)?;
    let (capture_nanos, frame_id) = message.header()?;
    let (height, width) = (message.u32("height")?, message.u32("width")?);
    let fields = read_fields(&mut message)?;
    // Values are in the order that the flag states, whatever the order of the message.
    let is_big_endian = message.u8("is_bigendian")? != 0;
    let (point_step, row_step) = (message.u32("point_step")?, message.u32("row_step")?);
    let data = message.bytes("data")?;
    let columns = PointColumns::find(&fields)?;
    let layout = CloudLayout {
        height,
        width,
        point_step,
        row_step,
    };
    layout.check(&columns, data.len(), limits)?;
    let mut sweep = RosSweep {
        capture_nanos,
        frame_id: frame_id.into(),
        points: PointCloud::default(),
        intensity: columns
            .intensity
            .map(|(name, _, kind)| (name.to_owned(), kind)),
        without_return: 0,
        too_far: 0,
    };
    if is_big_endian {
        sweep.fill::<BigEndian>(data, &layout, &columns, limits.max_abs_value);
    } else {
        sweep.fill::<LittleEndian>(data, &layout, &columns, limits.max_abs_value);
    }
    Ok(sweep)
}

/// Datatypes of `sensor_msgs/PointField`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::FromRepr)]
#[repr(u8)]
enum Datatype {
    Int8 = 1,
    Uint8,
    Int16,
    Uint16,
    Int32,
    Uint32,
    Float32,
    Float64,
}

impl Datatype {
    /// Bytes of a value.
    fn size(self) -> u32 {
        match self {
            Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 => 4,
            Self::Float64 => 8,
        }
    }

    /// The value at the beginning of `bytes`; `None` if there are too few.
    fn read<BO: ByteOrder>(self, bytes: &[u8]) -> Option<f64> {
        let value = bytes.get(..self.size() as usize)?;
        Some(match self {
            Self::Int8 => f64::from(value.first()?.cast_signed()),
            Self::Uint8 => f64::from(*value.first()?),
            Self::Int16 => BO::read_i16(value).into(),
            Self::Uint16 => BO::read_u16(value).into(),
            Self::Int32 => BO::read_i32(value).into(),
            Self::Uint32 => BO::read_u32(value).into(),
            Self::Float32 => BO::read_f32(value).into(),
            Self::Float64 => BO::read_f64(value),
        })
    }
}

/// A field of a point, as the message describes it.
struct RosField<'a> {
    name: &'a str,
    offset: u32,
    datatype: u8,
    count: u32,
}

/// A field that is read: its place in a point and its type.
#[derive(Debug, Clone, Copy)]
struct PointColumn {
    offset: u32,
    datatype: Datatype,
}

impl PointColumn {
    fn end(self) -> u64 {
        u64::from(self.offset) + u64::from(self.datatype.size())
    }

    fn value<BO: ByteOrder>(self, point: &[u8]) -> Option<f64> {
        self.datatype.read::<BO>(point.get(self.offset as usize..)?)
    }
}

/// Fields of a point that are read.
struct PointColumns<'a> {
    xyz: [PointColumn; 3],
    intensity: Option<(&'a str, PointColumn, IntensityKind)>,
}

impl<'a> PointColumns<'a> {
    fn find(fields: &[RosField<'a>]) -> Result<Self, ReadError> {
        let [x, y, z] = ["x", "y", "z"].map(|name| coordinate(fields, name));
        let (xyz, intensity) = ([x?, y?, z?], intensity(fields)?);
        Ok(Self { xyz, intensity })
    }

    fn end(&self) -> u64 {
        let intensity = self.intensity.iter().map(|(_, column, _)| column);
        let columns = self.xyz.iter().chain(intensity);
        columns.map(|column| column.end()).max().unwrap_or(0)
    }
}

fn coordinate(fields: &[RosField<'_>], name: &'static str) -> Result<PointColumn, ReadError> {
    let allowed = "datatype 7 or 8 (FLOAT32, FLOAT64) and count 1";
    let found = column(fields, name, allowed, |datatype| {
        matches!(datatype, Datatype::Float32 | Datatype::Float64)
    })?;
    found.map(|(_, column)| column).ok_or_else(|| {
        let names = fields.iter().map(|field| excerpt(field.name, 40));
        let found: Vec<String> = names.collect();
        ReadError(format!("no field {name:?} among {found:?}"))
    })
}

/// The field of the most preferred name of an intensity, else of a packed colour.
fn intensity<'a>(
    fields: &[RosField<'a>],
) -> Result<Option<(&'a str, PointColumn, IntensityKind)>, ReadError> {
    for name in INTENSITY_FIELDS {
        if let Some((name, found)) = column(fields, name, "datatype 1 to 8 and count 1", |_| true)?
        {
            let kind = match found.datatype {
                Datatype::Uint8 => IntensityKind::Byte,
                _ => IntensityKind::Number,
            };
            return Ok(Some((name, found, kind)));
        }
    }
    // A colour of another type is no packed one.
    let colour = (COLOUR_FIELDS.iter()).find_map(|name| {
        column(fields, name, "", |datatype| datatype.size() == 4)
            .ok()
            .flatten()
    });
    Ok(colour.map(|(name, mut found)| {
        // The four bytes are read as an integer, also where the field is stated as a float.
        found.datatype = Datatype::Uint32;
        (name, found, IntensityKind::RedByte)
    }))
}

/// The field `name`, compared without case, if there is one, with its name as written.
fn column<'a>(
    fields: &[RosField<'a>],
    name: &'static str,
    allowed: &'static str,
    is_allowed: impl Fn(Datatype) -> bool,
) -> Result<Option<(&'a str, PointColumn)>, ReadError> {
    let Some(field) = fields
        .iter()
        .find(|field| field.name.eq_ignore_ascii_case(name))
    else {
        return Ok(None);
    };
    match Datatype::from_repr(field.datatype).filter(|datatype| is_allowed(*datatype)) {
        // Some drivers leave the count at 0.
        Some(datatype) if field.count <= 1 => {
            let offset = field.offset;
            Ok(Some((field.name, PointColumn { offset, datatype })))
        }
        _ => Err(ReadError(format!(
            "field {name:?} has datatype {} and count {}, not {allowed}",
            field.datatype, field.count
        ))),
    }
}

/// Sizes of a cloud.
struct CloudLayout {
    height: u32,
    width: u32,
    point_step: u32,
    row_step: u32,
}

impl CloudLayout {
    /// Bytes from one row to the next.
    fn stride(&self) -> u64 {
        // The only row of a cloud needs no step, and some drivers give none.
        match self.height {
            2.. => self.row_step.into(),
            _ => u64::from(self.width) * u64::from(self.point_step),
        }
    }

    fn check(
        &self,
        columns: &PointColumns<'_>,
        data_len: usize,
        limits: &Limits,
    ) -> Result<(), ReadError> {
        let points = u64::from(self.height) * u64::from(self.width);
        at_most("height x width", points, limits.max_points)?;
        let step = self.point_step.into();
        at_least("point_step", step, columns.end(), "end of the last field")?;
        let row = u64::from(self.width) * u64::from(self.point_step);
        at_least("row_step", self.stride(), row, "width x point_step")?;
        // The last row needs its points only, not the padding up to the next row.
        let needed = self.height.checked_sub(1).map_or(0, |rows| {
            let padded = u64::from(rows).saturating_mul(self.stride());
            padded.saturating_add(row)
        });
        at_least("length of data", data_len as u64, needed, "rows x row_step")
    }
}

fn at_least(what: &str, found: u64, needed: u64, why: &str) -> Result<(), ReadError> {
    if found >= needed {
        return Ok(());
    }
    let problem = format!("{what} is {found}, not at least {needed} ({why})");
    Err(ReadError(problem))
}

fn at_most(what: &str, found: u64, max: u64) -> Result<(), ReadError> {
    if found <= max {
        return Ok(());
    }
    let problem = format!("{what}: {found}, at most {max} are accepted");
    Err(ReadError(problem))
}

fn read_fields<'a>(message: &mut Reader<'a>) -> Result<Vec<RosField<'a>>, ReadError> {
    let count = message.u32("length of fields")?;
    at_most("fields", count.into(), MAX_FIELDS.into())?;
    let fields = (0..count).map(|_| {
        Ok(RosField {
            name: message.str("fields.name")?,
            offset: message.u32("fields.offset")?,
            datatype: message.u8("fields.datatype")?,
            count: message.u32("fields.count")?,
        })
    });
    fields.collect()
}

impl RosSweep {
    /// Adds the points of `data`, whose layout was checked.
    fn fill<BO: ByteOrder>(
        &mut self,
        data: &[u8],
        layout: &CloudLayout,
        columns: &PointColumns<'_>,
        max_abs_value: f32,
    ) {
        let (stride, step) = (layout.stride(), layout.point_step as usize);
        // Rows of no points may be as many as they like.
        let rows = if layout.width == 0 { 0 } else { layout.height };
        for row in 0..u64::from(rows) {
            let begin = usize::try_from(row * stride).unwrap_or(usize::MAX);
            let row = data.get(begin..).unwrap_or_default();
            // A step of 0 was refused: it ends before the last field.
            for point in row.chunks(step.max(1)).take(layout.width as usize) {
                self.add::<BO>(point, columns, max_abs_value);
            }
        }
    }

    fn add<BO: ByteOrder>(&mut self, point: &[u8], columns: &PointColumns<'_>, max_abs_value: f32) {
        let xyz = columns
            .xyz
            .map(|column| column.value::<BO>(point).unwrap_or(f64::NAN));
        let limit = f64::from(max_abs_value);
        if !xyz.iter().all(|value| value.is_finite()) {
            self.without_return += 1;
        } else if xyz.iter().any(|value| value.abs() > limit) {
            self.too_far += 1;
        } else {
            let intensity = match &columns.intensity {
                Some((_, column, IntensityKind::RedByte)) => {
                    // Bits 16 to 23 of `0x00RRGGBB`: a u32 is exact in f64.
                    let colour = column.value::<BO>(point);
                    colour.map(|colour| (colour / 65_536.0).floor() % 256.0)
                }
                Some((_, column, _)) => column.value::<BO>(point),
                None => None,
            };
            let intensity = intensity.filter(|value| value.is_finite());
            let intensity = intensity.unwrap_or(0.0).clamp(-limit, limit);
            let [x, y, z] = xyz;
            self.points.xyzi.push([x, y, z, intensity].map(single));
        }
    }
}

/// The nearest value in single precision.
#[expect(clippy::cast_possible_truncation, reason = "within the limit, rounded")]
fn single(value: f64) -> f32 {
    value as f32
}

#[cfg(test)]
mod tests;
