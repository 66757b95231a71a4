//! Unknown field of a configuration: the similar name that was meant, or the kind of file that it belongs to.

/// Similarity (Jaro-Winkler) from which on a name is taken for a slip of another.
const SIMILAR: f64 = 0.8;
/// A field on the top level that only files of one kind have, and that kind with its command.
const KINDS: [(&str, &str); 5] = [
    ("grid", "an experiment: v2vloc sweep FILE"),
    (
        "tables",
        "a file of tables: v2vloc eval --table FILE --out DIR",
    ),
    ("models", "a scenario: v2vloc up FILE"),
    ("capacity", "a link: v2vloc eval --link FILE"),
    (
        "cav",
        "the configuration of an agent: agent run --config FILE",
    ),
];

/// The reason of an error; where it is an unknown field, with the hint that helps. `fields` are those of the document's
/// top level if the unknown one is among them.
pub(crate) fn explained(reason: String, fields: &[String]) -> String {
    let Some((unknown, expected)) = parts(&reason) else {
        return reason;
    };
    // A field that only another kind of file has says more than one that is spelled like a known one.
    let of_another_kind = KINDS
        .iter()
        .find(|(field, _)| !expected.contains(field) && fields.iter().any(|own| own == field));
    if let Some((_, kind)) = of_another_kind {
        return format!("unknown field `{unknown}`: this is {kind}");
    }
    let nearest = expected
        .iter()
        .map(|name| (strsim::jaro_winkler(unknown, name), name))
        .max_by(|(a, _), (b, _)| a.total_cmp(b))
        .filter(|(likeness, _)| expected.len() > 1 && *likeness > SIMILAR);
    match nearest {
        Some((_, name)) => format!(
            "unknown field `{unknown}`, did you mean `{name}`? The fields are {}",
            expected.join(", ")
        ),
        None => reason,
    }
}

/// The unknown field and the known ones of serde's message, in which these are quoted or not.
fn parts(reason: &str) -> Option<(&str, Vec<&str>)> {
    let (unknown, rest) = reason.strip_prefix("unknown field `")?.split_once('`')?;
    let known = rest.strip_prefix(", expected ")?;
    let known = known.strip_prefix("one of ").unwrap_or(known);
    let names = known.split(", ").map(|name| name.trim_matches('`'));
    Some((unknown, names.collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const REASON: &str = "unknown field `metod`, expected one of `run`, `method`, `scene`";

    #[test]
    fn a_slip_is_answered_with_the_name_that_was_meant() {
        assert_eq!(
            explained(REASON.into(), &[]),
            "unknown field `metod`, did you mean `method`? The fields are run, method, scene"
        );
        let other = REASON.replace("metod", "velocity");
        assert_eq!(explained(other.clone(), &["velocity".into()]), other);
        let plain = "unknown field `metod`, expected one of run, method, scene";
        assert_eq!(explained(plain.into(), &[]), explained(REASON.into(), &[]));
        let single = "unknown field `rat`, expected `rate`";
        assert_eq!(explained(single.into(), &[]), single);
        assert_eq!(
            explained("missing field `scene`".into(), &[]),
            "missing field `scene`"
        );
    }

    #[test]
    fn a_file_of_another_kind_is_named_with_its_command() {
        let fields = ["name", "grid"].map(String::from);
        let reason = explained(REASON.replace("metod", "name"), &fields);
        assert_eq!(
            reason,
            "unknown field `name`: this is an experiment: v2vloc sweep FILE"
        );
    }
}
