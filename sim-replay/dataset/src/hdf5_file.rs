//! The HDF5 files of LightLoc's poses: `valid_timestamps` (`n`, microseconds, `i64`) and `poses` (`n x 12`, `f64`).
//!
//! Version 0 of the superblock, version 1 of object headers, contiguous data: the oldest form, which every HDF5 library
//! reads. Two data sets of numbers need no more, and no C library.

#![expect(
    clippy::cast_possible_truncation,
    reason = "names, shapes and messages that this module writes itself are short"
)]

/// A signed number of 8 bytes, little-endian, and a double, as messages of type.
const I64: [u8; 12] = [0x10, 0x08, 0, 0, 8, 0, 0, 0, 0, 0, 64, 0];
const F64: [u8; 20] = [
    0x11, 0x20, 0x3f, 0, 8, 0, 0, 0, 0, 0, 64, 0, 52, 11, 0, 52, 0xff, 0x03, 0, 0,
];
/// An undefined address.
const UNDEFINED: [u8; 8] = [0xff; 8];
/// Offset of the root group, after the superblock.
const ROOT: usize = 96;

/// A message of an object header: type, and data padded to 8 bytes.
fn message(kind: u16, mut data: Vec<u8>) -> Vec<u8> {
    data.resize(data.len().next_multiple_of(8), 0);
    let len = (data.len() as u16).to_le_bytes();
    [&kind.to_le_bytes()[..], &len, &[0; 4], &data].concat()
}

fn object_header(messages: &[Vec<u8>]) -> Vec<u8> {
    let body = messages.concat();
    let mut header = vec![1, 0];
    header.extend((messages.len() as u16).to_le_bytes());
    header.extend(1u32.to_le_bytes());
    header.extend((body.len() as u32).to_le_bytes());
    header.extend([0; 4]);
    header.extend(body);
    header
}

/// The header of a data set of `bytes` bytes at `address`.
fn dataset_header(shape: &[u64], datatype: &[u8], address: usize, bytes: usize) -> Vec<u8> {
    let mut space = vec![1, shape.len() as u8, 0, 0, 0, 0, 0, 0];
    space.extend(shape.iter().flat_map(|size| size.to_le_bytes()));
    let mut layout = vec![3, 1];
    layout.extend((address as u64).to_le_bytes());
    layout.extend((bytes as u64).to_le_bytes());
    object_header(&[
        message(1, space),
        message(3, datatype.to_vec()),
        message(8, layout),
    ])
}

/// A link of a group to the object at `address`.
fn link(name: &str, address: usize) -> Vec<u8> {
    let mut link = vec![1, 0, name.len() as u8];
    link.extend(name.bytes());
    link.extend((address as u64).to_le_bytes());
    message(6, link)
}

/// The header of the root group, with links to the data sets at these addresses.
fn root_header(stamps: usize, poses: usize) -> Vec<u8> {
    object_header(&[
        message(2, [&[0, 0][..], &UNDEFINED, &UNDEFINED].concat()),
        link("valid_timestamps", stamps),
        link("poses", poses),
    ])
}

fn superblock(end: usize) -> Vec<u8> {
    let mut block = b"\x89HDF\r\n\x1a\n".to_vec();
    block.extend([0, 0, 0, 0, 0, 8, 8, 0, 4, 0, 16, 0, 0, 0, 0, 0]);
    block.extend(0u64.to_le_bytes());
    block.extend(UNDEFINED);
    block.extend((end as u64).to_le_bytes());
    block.extend(UNDEFINED);
    block.extend(0u64.to_le_bytes());
    block.extend((ROOT as u64).to_le_bytes());
    block.extend([0; 24]);
    block
}

/// The bytes of a file with these time stamps and rows.
pub fn poses_file(stamps: &[i64], poses: &[[f64; 12]]) -> Vec<u8> {
    let values = stamps.iter();
    let stamp_bytes: Vec<u8> = values.flat_map(|stamp| stamp.to_le_bytes()).collect();
    let values = poses.as_flattened().iter();
    let pose_bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
    let (stamps, poses) = ([stamps.len() as u64], [poses.len() as u64, 12]);
    let (stamp_len, pose_len) = (stamp_bytes.len(), pose_bytes.len());
    // Headers have the same length for every address.
    let first = ROOT + root_header(0, 0).len();
    let second = first + dataset_header(&stamps, &I64, 0, stamp_len).len();
    let data = second + dataset_header(&poses, &F64, 0, pose_len).len();
    let pose_data = data + stamp_len;

    let mut file = superblock(pose_data + pose_len);
    file.extend(root_header(first, second));
    file.extend(dataset_header(&stamps, &I64, data, stamp_len));
    file.extend(dataset_header(&poses, &F64, pose_data, pose_len));
    file.extend(stamp_bytes);
    file.extend(pose_bytes);
    file
}
