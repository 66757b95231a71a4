use super::*;

const SOUND: &str = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n\
                     WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n";

fn error_after(from: &str, to: &str) -> String {
    let text = SOUND.replace(from, to);
    assert_ne!(text, SOUND, "{from}");
    Header::parse(text.as_bytes()).unwrap_err().to_string()
}

#[test]
fn a_sound_header_is_taken_apart() {
    let (header, body) = Header::parse(format!("{SOUND}rest").as_bytes()).map(|(h, b)| (h, b.to_vec())).unwrap();
    assert_eq!((header.points, header.columns(), header.stride(), header.lines), (2, 4, 16, 11));
    assert_eq!((header.xyz, header.intensity), ([0, 1, 2], IntensitySource::Red(3)));
    assert_eq!(body, b"rest");
}

#[test]
fn what_does_not_fit_is_named_with_line_and_both_values() {
    let cases = [
        ("VERSION 0.7", "VERSION 1.0", "line 2: VERSION: \"1.0\", expected 0.7"),
        ("SIZE 4 4 4 4", "SIZE 4 4 4", "line 4: SIZE: 3 values for 4 FIELDS"),
        ("SIZE 4 4 4 4", "SIZE 4 2 4 4", "line 4: SIZE: \"2\" of field y, expected one of [4, 8] for TYPE F"),
        ("TYPE F F F F", "TYPE F F Q F", "line 5: TYPE: \"Q\" of field z, expected F, I or U"),
        ("COUNT 1 1 1 1", "COUNT 1 1 0 1", "line 6: COUNT: \"0\" of field z, expected 1 to 65536"),
        ("COUNT 1 1 1 1", "COUNT 2 1 1 1", "line 3: COUNT: 2 of field x, expected 1"),
        ("FIELDS x y z rgb", "FIELDS x y h rgb", "line 3: FIELDS: no field z"),
        ("FIELDS x y z rgb", "FIELDS x y z x", "line 3: FIELDS: x stands there twice"),
        ("POINTS 2", "POINTS 3", "line 10: POINTS: 3, but WIDTH 2 x HEIGHT 1 says otherwise"),
        ("WIDTH 2", "WIDTH two", "line 7: WIDTH: \"two\" is no count"),
        ("WIDTH 2", "WIDTH -2", "line 7: WIDTH: \"-2\" is no count"),
        ("HEIGHT 1\n", "", "HEIGHT: missing in the header"),
        ("HEIGHT 1", "HEIGHT 1\nHEIGHT 1", "line 9: HEIGHT: stands here a second time"),
        ("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 0 0", "line 9: VIEWPOINT: 2 values, expected 7"),
        ("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 0 0 0 1 0 0 x", "line 9: VIEWPOINT: \"x\" is no finite number"),
        ("DATA ascii", "DATA hex", "line 11: DATA: \"hex\", expected ascii, binary or binary_compressed"),
        ("DATA ascii\n", "", "line 11: DATA: the header ends before a DATA line"),
        ("VERSION 0.7", "HELLO 0.7", "line 2: \"HELLO\" is no PCD header key"),
    ];
    for (from, to, message) in cases {
        assert_eq!(error_after(from, to), message);
    }
}

#[test]
fn absurd_counts_are_refused() {
    let absurd = SOUND.replace("WIDTH 2", "WIDTH 99999999999").replace("POINTS 2", "POINTS 99999999999");
    assert!(Header::parse(absurd.as_bytes()).unwrap_err().reason.contains("at most 50000000"));
    let wrapping = SOUND.replace("WIDTH 2", "WIDTH 9223372036854775808").replace("HEIGHT 1", "HEIGHT 2");
    assert!(Header::parse(wrapping.replace("POINTS 2", "POINTS 0").as_bytes()).is_err());
}

#[test]
fn carriage_returns_are_whitespace() {
    assert!(Header::parse(SOUND.replace('\n', "\r\n").as_bytes()).is_ok());
}
