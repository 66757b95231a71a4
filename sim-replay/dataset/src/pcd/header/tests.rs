use super::*;

const SOUND: &str = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n\
                     WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n";

fn error_after(from: &str, to: &str) -> String {
    let text = SOUND.replace(from, to);
    assert_ne!(text, SOUND, "{from}");
    PcdHeader::parse(text.as_bytes()).unwrap_err().to_string()
}

#[test]
fn a_sound_header_is_taken_apart() {
    let (header, body) = PcdHeader::parse(format!("{SOUND}rest").as_bytes())
        .map(|(h, b)| (h, b.to_vec()))
        .unwrap();
    assert_eq!(
        (
            header.points,
            header.columns(),
            header.stride(),
            header.lines
        ),
        (2, 4, 16, 11)
    );
    assert_eq!(
        (header.xyz, header.intensity),
        ([0, 1, 2], IntensitySource::Red(3))
    );
    assert_eq!(body, b"rest");
}

#[test]
fn inconsistent_values_are_reported_with_line_and_both_values() {
    let cases = [
        (
            "VERSION 0.7",
            "VERSION 1.0",
            "line 2: VERSION: \"1.0\", expected 0.7, 0.6 or 0.5",
        ),
        (
            "SIZE 4 4 4 4",
            "SIZE 4 4 4",
            "line 4: SIZE: 3 values for 4 FIELDS",
        ),
        (
            "SIZE 4 4 4 4",
            "SIZE 4 2 4 4",
            "line 4: SIZE: 2 of field y, expected one of [4, 8] for TYPE F",
        ),
        (
            "TYPE F F F F",
            "TYPE F F Q F",
            "line 5: TYPE: \"Q\" of field z, expected F, I or U",
        ),
        (
            "COUNT 1 1 1 1",
            "COUNT 1 1 0 1",
            "line 3: COUNT: 0 of field z, expected 1",
        ),
        (
            "COUNT 1 1 1 1",
            "COUNT 1 1 1 -1",
            "line 6: COUNT: \"-1\" of field rgb, expected 0 to 65536",
        ),
        (
            "SIZE 4 4 4 4",
            "SIZE 4 4 4 9",
            "line 4: SIZE: \"9\" of field rgb, expected 1 to 8",
        ),
        (
            "SIZE 4 4 4 4",
            "SIZE 4 4 4 8",
            "line 4: SIZE: 8 of field rgb, expected one of [4] for TYPE F",
        ),
        (
            "COUNT 1 1 1 1",
            "COUNT 2 1 1 1",
            "line 3: COUNT: 2 of field x, expected 1",
        ),
        (
            "FIELDS x y z rgb",
            "FIELDS x y h rgb",
            "line 3: FIELDS: no field z",
        ),
        (
            "FIELDS x y z rgb",
            "FIELDS x y z x",
            "line 3: FIELDS: x is given twice",
        ),
        (
            "POINTS 2",
            "POINTS 3",
            "line 10: POINTS: 3, which does not match WIDTH 2 x HEIGHT 1",
        ),
        ("WIDTH 2", "WIDTH two", "line 7: WIDTH: \"two\" is no count"),
        ("WIDTH 2", "WIDTH -2", "line 7: WIDTH: \"-2\" is no count"),
        (
            "WIDTH 2\nHEIGHT 1\n",
            "WIDTH 3\n",
            "line 9: POINTS: 2, which does not match WIDTH 3 of no HEIGHT",
        ),
        (
            "HEIGHT 1",
            "HEIGHT 1\nHEIGHT 1",
            "line 9: HEIGHT: is given a second time",
        ),
        (
            "VIEWPOINT 0 0 0 1 0 0 0",
            "VIEWPOINT 0 0",
            "line 9: VIEWPOINT: 2 values, expected 7",
        ),
        (
            "VIEWPOINT 0 0 0 1 0 0 0",
            "VIEWPOINT 0 0 0 1 0 0 x",
            "line 9: VIEWPOINT: \"x\" is no finite number",
        ),
        (
            "DATA ascii",
            "DATA hex",
            "line 11: DATA: \"hex\", expected ascii, binary or binary_compressed",
        ),
        (
            "DATA ascii\n",
            "",
            "line 11: DATA: the header ends before a DATA line",
        ),
        (
            "VERSION 0.7",
            "HELLO 0.7",
            "line 2: \"HELLO\" is no PCD header key",
        ),
    ];
    for (from, to, message) in cases {
        assert_eq!(error_after(from, to), message);
    }
}

#[test]
fn absurd_counts_are_refused() {
    let absurd = SOUND
        .replace("WIDTH 2", "WIDTH 99999999999")
        .replace("POINTS 2", "POINTS 99999999999");
    assert!(
        PcdHeader::parse(absurd.as_bytes())
            .unwrap_err()
            .reason
            .contains("at most 10000000")
    );
    let wrapping = SOUND
        .replace("WIDTH 2", "WIDTH 9223372036854775808")
        .replace("HEIGHT 1", "HEIGHT 2");
    assert!(PcdHeader::parse(wrapping.replace("POINTS 2", "POINTS 0").as_bytes()).is_err());
}

#[test]
fn carriage_returns_are_whitespace() {
    assert!(PcdHeader::parse(SOUND.replace('\n', "\r\n").as_bytes()).is_ok());
}

fn parsed(text: &str) -> PcdHeader {
    PcdHeader::parse(text.as_bytes())
        .unwrap_or_else(|error| panic!("{error}:\n{text}"))
        .0
}

#[test]
fn missing_entries_follow_from_the_rest() {
    let sound = parsed(SOUND);
    for version in [
        "VERSION .7",
        "VERSION .6",
        "VERSION 0.6",
        "VERSION .5",
        "VERSION 0.5",
        "# no version",
    ] {
        assert_eq!(
            parsed(&SOUND.replace("VERSION 0.7", version)),
            sound,
            "{version}"
        );
    }
    for missing in [
        "COUNT 1 1 1 1\n",
        "HEIGHT 1\n",
        "WIDTH 2\n",
        "POINTS 2\n",
        "VIEWPOINT 0 0 0 1 0 0 0\n",
    ] {
        assert_eq!(
            PcdHeader {
                lines: 11,
                ..parsed(&SOUND.replace(missing, ""))
            },
            sound,
            "{missing}"
        );
    }
    let organised = SOUND
        .replace("WIDTH 2\nHEIGHT 1\n", "WIDTH 2\nHEIGHT 3\n")
        .replace("POINTS 2\n", "");
    assert_eq!(parsed(&organised).points, 6);
    let rows = SOUND
        .replace("HEIGHT 1\n", "")
        .replace("POINTS 2", "POINTS 6");
    assert_eq!(parsed(&rows).points, 6);
    let neither = SOUND.replace("WIDTH 2\n", "").replace("POINTS 2\n", "");
    let message = PcdHeader::parse(neither.as_bytes())
        .unwrap_err()
        .to_string();
    assert_eq!(message, "POINTS: missing in the header, and WIDTH too");
}

#[test]
fn spelling_and_comments_do_not_matter() {
    let sound = parsed(SOUND);
    assert_eq!(parsed(&SOUND.replace("FIELDS", "COLUMNS")), sound);
    assert_eq!(
        parsed(&SOUND.replace(' ', " \t ").replace('\n', " \r\n")),
        sound
    );
    assert_eq!(parsed(&format!("\u{feff}{SOUND}")), sound);
    assert_eq!(
        parsed(&SOUND.replace("HEIGHT 1", "HEIGHT 1 # one row")),
        sound
    );
    let lower = SOUND.lines().map(|line| {
        let (key, rest) = line.split_once(' ').unwrap();
        format!("{} {rest}\n", key.to_lowercase())
    });
    assert_eq!(parsed(&lower.collect::<String>()), sound);
    let commented = SOUND.replace("WIDTH", "# \u{4e2d}\n\n#\nWIDTH");
    assert_eq!(
        PcdHeader {
            lines: 11,
            ..parsed(&commented)
        },
        sound
    );
    let mut latin = b"# caf\xe9\n".to_vec();
    latin.extend(SOUND.as_bytes());
    assert_eq!(PcdHeader::parse(&latin).unwrap().0.lines, 12);
}

#[test]
fn padding_may_repeat_and_hold_nothing() {
    let header = parsed(
        "FIELDS x y z _ intensity _ ring _\nSIZE 4 4 4 1 4 1 2 3\nTYPE F F F U F U U Q\nCOUNT 1 1 1 4 1 0 1 2\n\
         WIDTH 3\nDATA binary\n",
    );
    assert_eq!(
        (header.stride(), header.intensity, header.points),
        (12 + 4 + 4 + 2 + 6, IntensitySource::Value(4), 3)
    );
}

/// Name and kind of the intensity among fields of four bytes.
fn intensity_among(names: &str) -> Option<(String, IntensityKind)> {
    let count = names.split(' ').count() + 3;
    let [sizes, types] = ["4", "F"].map(|word| vec![word; count].join(" "));
    let header = parsed(&format!(
        "FIELDS x y z {names}\nSIZE {sizes}\nTYPE {types}\nWIDTH 0\nDATA ascii\n"
    ));
    header
        .intensity_origin()
        .map(|(name, kind)| (name.to_owned(), kind))
}

#[test]
fn the_most_preferred_name_of_intensity_wins() {
    for name in [
        "intensity",
        "Intensity",
        "INTENSITY",
        "i",
        "reflectivity",
        "scalar_Intensity",
        "reflectance",
        "remission",
    ] {
        assert_eq!(
            intensity_among(&format!("rgb {name} ring")),
            Some((name.to_owned(), IntensityKind::Number))
        );
    }
    assert_eq!(
        intensity_among("reflectivity signal i Intensity")
            .unwrap()
            .0,
        "Intensity"
    );
    assert_eq!(intensity_among("reflectivity signal i").unwrap().0, "i");
    assert_eq!(
        intensity_among("rgba"),
        Some(("rgba".to_owned(), IntensityKind::RedByte))
    );
    assert_eq!(intensity_among("ring"), None);
    let bytes = SOUND
        .replace("rgb", "intensity")
        .replace("TYPE F F F F", "TYPE F F F U")
        .replace("4 4 4 4", "4 4 4 1");
    assert_eq!(
        parsed(&bytes).intensity_origin(),
        Some(("intensity", IntensityKind::Byte))
    );
}
