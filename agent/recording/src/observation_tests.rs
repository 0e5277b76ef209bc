use super::*;
use merganser_protocol::submap::{PlaceError, UpError};

fn message() -> KeyframeMessage {
    let mut covariance = [0.0; 21];
    for (i, start) in [0, 6, 11, 15, 18, 20].into_iter().enumerate() {
        covariance[start] = 1e-4 * (i + 1) as f64;
    }
    KeyframeMessage {
        stamp_ns: -5,
        translation: [1.0, 2.0, 3.0],
        rotation: [0.1, 0.2, 0.3, 0.9],
        covariance,
        covariance_of: CovarianceOf::Pose,
        points: vec![[1.0, 2.0, 3.0], [-1.0, 0.5, 0.25]],
        landmarks: vec![],
        place: None,
        depth: None,
        organised: false,
        session: None,
        up: None,
    }
}

fn of_a_session() -> KeyframeMessage {
    KeyframeMessage { session: Some(1_700_000_000), ..of_a_place() }
}

fn of_a_place() -> KeyframeMessage {
    let place = PlaceMessage { model: "net".into(), metric: Metric::Euclidean, vector: vec![0.25, -3.0, 1.5] };
    KeyframeMessage { place: Some(place), ..message() }
}

fn of_landmarks() -> KeyframeMessage {
    let covariance = [0.01, 0.001, 0.0, 0.02, 0.0, 0.03];
    let named = LandmarkMessage { covariance, label: Some(72), descriptor: None };
    let described = LandmarkMessage { covariance, label: None, descriptor: Some([7; 32]) };
    KeyframeMessage { landmarks: vec![named, described], ..message() }
}

#[test]
fn landmarks_travel_with_their_points() {
    let json = serde_json::to_vec(&of_landmarks()).unwrap();
    let postcard = postcard::to_stdvec(&of_landmarks()).unwrap();
    let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
    assert_eq!(a, b);
    assert_eq!((a.marks[0].label, a.marks[1].descriptor), (Some(72), Some([7; 32])));
    assert_eq!(KeyframeMessage::from(&a).landmarks, of_landmarks().landmarks);
}

#[test]
fn a_place_travels_and_is_checked() {
    let json = serde_json::to_vec(&of_a_place()).unwrap();
    let postcard = postcard::to_stdvec(&of_a_place()).unwrap();
    let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
    assert_eq!(a, b);
    assert_eq!(KeyframeMessage::from(&a), KeyframeMessage { rotation: a.pose.pose.rotation.xyzw(), ..of_a_place() });
    let mut zero = of_a_place();
    zero.place.as_mut().unwrap().vector = vec![0.0; 3];
    assert_eq!(Keyframe::try_from(zero), Err(ObservationError::Place(PlaceError::Zero)));
    let written = br#"{"metric": "cosine", "vector": [1, 2]}"#;
    assert_eq!(serde_json::from_slice::<PlaceMessage>(written).unwrap().model, "");
}

/// What was added after the points, each a zero byte in a message that has none of it: up, session, organised, depth,
/// place, landmarks, the last one first.
const ADDED: usize = 6;

#[test]
fn a_session_travels() {
    let json = serde_json::to_vec(&of_a_session()).unwrap();
    let postcard = postcard::to_stdvec(&of_a_session()).unwrap();
    let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
    assert_eq!(a, b);
    assert_eq!(a.session, Some(1_700_000_000));
    assert_eq!(KeyframeMessage::from(&a).session, a.session);
    let mut json = serde_json::to_value(message()).unwrap();
    json["session"] = (-1).into();
    assert!(matches!(keyframe(Format::Json, json.to_string().as_bytes()), Err(ObservationError::Json(_))));
}

fn upright() -> KeyframeMessage {
    KeyframeMessage { up: Some(UpMessage { direction: [0.6, 0.0, 0.8], sigma_rad: 0.01 }), ..message() }
}

#[test]
fn which_way_is_up_travels_and_is_checked() {
    let json = serde_json::to_vec(&upright()).unwrap();
    let postcard = postcard::to_stdvec(&upright()).unwrap();
    let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
    assert_eq!(a, b);
    assert_eq!(a.up, Some(Up::new([0.6, 0.0, 0.8], 0.01).unwrap()));
    assert_eq!(KeyframeMessage::from(&a).up.map(|up| up.sigma_rad), Some(0.01));
    let written = br#"{"direction": [0, 0, 1]}"#;
    assert_eq!(serde_json::from_slice::<UpMessage>(written).unwrap().sigma_rad, UP_SIGMA_RAD);
    let told = |direction, sigma_rad| {
        Keyframe::try_from(KeyframeMessage { up: Some(UpMessage { direction, sigma_rad }), ..message() }).map(drop)
    };
    assert_eq!(told([0.0, 0.0, 9.81], 0.02), Err(ObservationError::Up(UpError::Length(9.81))));
    assert_eq!(told([0.0, 0.0, 1.0], 0.6), Err(ObservationError::Up(UpError::Sigma(0.6))));
    assert!(matches!(told([0.0, f64::NAN, 1.0], 0.02), Err(ObservationError::Up(UpError::Length(_)))));
}

#[test]
fn what_was_sent_before_there_were_verticals_sessions_places_or_landmarks_is_understood() {
    let whole = |message: &KeyframeMessage| postcard::to_stdvec(message).unwrap();
    let of = |bytes: &[u8]| keyframe(Format::Postcard, bytes);
    let (plain, marked, placed) = (whole(&message()), whole(&of_landmarks()), whole(&of_a_place()));
    let (told, upright) = (whole(&of_a_session()), whole(&upright()));
    assert!(plain.ends_with(&[0; ADDED]) && marked.ends_with(&[0; ADDED - 1]) && placed.ends_with(&[0; ADDED - 2]));
    // Cut before what its session says, it is one of a place.
    let is_placed = |bytes: &[u8], len: usize| {
        (placed.len() - (ADDED - 2)..placed.len()).contains(&len) && placed.starts_with(&bytes[..len])
    };
    for (bytes, added) in [(&plain, ADDED), (&marked, ADDED - 1), (&placed, ADDED - 2), (&told, 1), (&upright, 0)] {
        for missing in 1..=added {
            assert_eq!(of(&bytes[..bytes.len() - missing]), of(bytes));
        }
        // Anything shorter was cut. Up to the end of its points or of no landmarks, it is a plain one.
        let is_plain =
            |len: usize| (plain.len() - ADDED..plain.len()).contains(&len) && plain.starts_with(&bytes[..len]);
        for len in (0..bytes.len() - added).filter(|&len| !is_plain(len)) {
            assert!(of(&bytes[..len]).is_err() || is_placed(bytes, len), "cut to {len} of {}", bytes.len());
        }
    }
    for extra in [&[0][..], &[0, 0], &[1]] {
        let longer = [&plain[..], extra].concat();
        assert_eq!(of(&longer), Err(ObservationError::Trailing(extra.len())));
    }
}

#[test]
fn landmarks_that_do_not_fit_are_refused() {
    let told = |change: &dyn Fn(&mut KeyframeMessage)| {
        let mut message = of_landmarks();
        change(&mut message);
        Keyframe::try_from(message).map(drop)
    };
    assert_eq!(told(&|_| ()), Ok(()));
    assert_eq!(told(&|m| m.landmarks.truncate(1)), Err(ObservationError::Landmarks { points: 2, landmarks: 1 }));
    let error = CovarianceError::NotPositiveDefinite;
    let refused = ObservationError::LandmarkCovariance { index: 1, error };
    assert_eq!(told(&|m| m.landmarks[1].covariance[1] = 0.5), Err(refused));
    let refused = ObservationError::LandmarkCovariance { index: 0, error: CovarianceError::NotFinite };
    assert_eq!(told(&|m| m.landmarks[0].covariance[5] = f64::NAN), Err(refused));
}

#[test]
fn json_and_postcard_say_the_same() {
    let json = serde_json::to_vec(&message()).unwrap();
    let postcard = postcard::to_stdvec(&message()).unwrap();
    let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
    assert_eq!(a, b);
    assert_eq!((a.stamp, a.covariance_of, a.points.len()), (Stamp(-5), CovarianceOf::Pose, 2));
}

#[test]
fn the_documented_json_is_a_keyframe() {
    let text: String = include_str!("observation.rs")
        .lines()
        .skip_while(|line| *line != "//! ```json")
        .skip(1)
        .take_while(|line| *line != "//! ```")
        .map(|line| line.trim_start_matches("//!"))
        .collect();
    keyframe(Format::Json, text.as_bytes()).unwrap();
}

#[test]
fn each_damage_is_refused() {
    let refused = |change: &dyn Fn(&mut KeyframeMessage)| {
        let mut bad = message();
        change(&mut bad);
        keyframe(Format::Postcard, &postcard::to_stdvec(&bad).unwrap()).unwrap_err()
    };
    assert_eq!(refused(&|m| m.translation[1] = f64::NAN), ObservationError::Number("translation"));
    assert_eq!(refused(&|m| m.translation[1] = 2.0 * COORDINATE_MAX), ObservationError::Number("translation"));
    assert_eq!(refused(&|m| m.rotation = [0.0; 4]), ObservationError::Rotation);
    assert_eq!(refused(&|m| m.points[1][2] = f32::INFINITY), ObservationError::Number("points"));
    assert_eq!(refused(&|m| m.points = vec![[0.0; 3]; POINTS_MAX + 1]), ObservationError::Points(POINTS_MAX + 1));
    assert!(matches!(refused(&|m| m.covariance[6] = -1.0), ObservationError::Covariance(_)));
    assert!(matches!(refused(&|m| m.covariance[1] = 1.0), ObservationError::Covariance(_)));
}

#[test]
fn decoding_takes_the_whole_input_and_known_fields_alone() {
    let good = postcard::to_stdvec(&message()).unwrap();
    let long = [good, vec![0, 0]].concat();
    assert_eq!(keyframe(Format::Postcard, &long), Err(ObservationError::Trailing(2)));
    let mut json = serde_json::to_value(message()).unwrap();
    json["colour"] = 1.into();
    assert!(matches!(keyframe(Format::Json, json.to_string().as_bytes()), Err(ObservationError::Json(_))));
}

/// Wheel odometry's drivers mark z, roll and pitch so.
#[test]
fn axes_that_are_marked_as_not_measured_are_taken_as_very_uncertain() {
    for mark in [-1.0, 0.0] {
        let mut marked = message();
        for place in [11, 15, 18] {
            marked.covariance[place] = mark;
        }
        for other in [2, 3, 4, 7, 8, 9, 12, 13, 14, 16, 17, 19] {
            marked.covariance[other] = 0.0;
        }
        let taken = keyframe(Format::Json, &serde_json::to_vec(&marked).unwrap()).unwrap();
        let sigmas = taken.pose.covariance.sigmas();
        assert!(sigmas.fixed_rows::<3>(2).min() == 1e3 && sigmas[0] < 1.0 && sigmas[5] < 1.0, "{sigmas}");
        marked.covariance[0] = mark;
        let refused = keyframe(Format::Json, &serde_json::to_vec(&marked).unwrap());
        assert!(matches!(refused, Err(ObservationError::Covariance(_))), "what a robot must measure: {refused:?}");
    }
}

#[test]
fn organised_clouds_leave_out_what_was_not_measured_and_others_are_refused_for_it() {
    let holes = [[f32::NAN; 3], [1.0, 2.0, f32::NAN], [f32::INFINITY, 0.0, 0.0], [0.0, f32::NEG_INFINITY, 0.0]];
    let mut cloud = KeyframeMessage { organised: true, ..message() };
    cloud.points.splice(1..1, holes);
    let taken = keyframe(Format::Postcard, &postcard::to_stdvec(&cloud).unwrap()).unwrap();
    assert_eq!(taken.points, message().points);
    let as_it_is = KeyframeMessage { organised: false, ..cloud.clone() };
    assert_eq!(Keyframe::try_from(as_it_is), Err(ObservationError::Number("points")));
    let empty = KeyframeMessage { points: holes.to_vec(), ..cloud.clone() };
    assert_eq!(Keyframe::try_from(empty), Err(ObservationError::Unmeasured(4)));
    let far = KeyframeMessage { points: vec![[2e7, 0.0, 0.0]], ..cloud };
    assert_eq!(Keyframe::try_from(far), Err(ObservationError::Number("points")));
    let marked = KeyframeMessage { organised: true, ..of_landmarks() };
    assert_eq!(Keyframe::try_from(marked), Err(ObservationError::OrganisedLandmarks));
}

#[test]
fn a_keyframe_that_saw_nothing_says_so() {
    let mut json = serde_json::to_value(message()).unwrap();
    json["points"] = serde_json::json!([]);
    assert!(keyframe(Format::Json, json.to_string().as_bytes()).unwrap().points.is_empty());
    json.as_object_mut().unwrap().remove("points");
    assert_eq!(keyframe(Format::Json, json.to_string().as_bytes()), Err(ObservationError::Neither));
}

#[test]
fn a_sighting_is_checked_like_a_keyframe() {
    let m = message();
    let (translation, rotation, covariance) = (m.translation, m.rotation, m.covariance);
    let robot = Name::new("beta").unwrap();
    let good = SightingMessage { stamp_ns: 7, robot, translation, rotation, covariance };
    let json = serde_json::to_vec(&good).unwrap();
    let seen = sighting(Format::Json, &json).unwrap();
    assert_eq!((seen.stamp, seen.covariance), (Stamp(7), covariance));
    let bad = SightingMessage { rotation: [0.0; 4], ..good };
    assert_eq!(Sighting::try_from(bad), Err(ObservationError::Rotation));
}

#[test]
fn a_position_is_checked_too() {
    let covariance = [0.01, 0.0, 0.0, 0.02, 0.0, 1.0];
    let robot = Name::new("beta").unwrap();
    let good = PositionMessage { stamp_ns: 7, robot, position: [1.0, 2.0, 0.0], covariance };
    let seen = position(Format::Json, &serde_json::to_vec(&good).unwrap()).unwrap();
    assert_eq!((seen.stamp, seen.position, seen.covariance), (Stamp(7), good.position, covariance));
    assert_eq!(position(Format::Postcard, &postcard::to_stdvec(&good).unwrap()), Ok(seen));
    let refused = |spoil: &dyn Fn(&mut PositionMessage)| {
        let mut bad = good.clone();
        spoil(&mut bad);
        PositionSighting::try_from(bad).unwrap_err()
    };
    assert_eq!(refused(&|m| m.position[1] = f64::NAN), ObservationError::Number("position"));
    assert!(matches!(refused(&|m| m.covariance[5] = 0.0), ObservationError::Covariance(_)));
    assert!(matches!(refused(&|m| m.covariance[1] = 1.0), ObservationError::Covariance(_)));
}

#[test]
fn what_a_first_user_sends_is_told_by_field_count_and_order() {
    let good = r#"{"stamp_ns": 1, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "covariance": C, "points": [[1, 2, 3]]}"#;
    let diagonal = |value: f64| {
        let cells = (0..6).flat_map(|r| (r..6).map(move |c| if r == c { value } else { 0.0 }));
        format!("{:?}", cells.collect::<Vec<_>>())
    };
    let good = good.replace('C', &diagonal(1e-4));
    assert!(keyframe(Format::Json, good.as_bytes()).is_ok());
    let told = |text: &str| keyframe(Format::Json, text.as_bytes()).unwrap_err().to_string();
    let cases: [(&str, &str, &[&str]); 14] = [
        ("[[1, 2, 3]]", "[[1, 2, 3, 0.5]]", &["points: [x, y, z] of each, not 4 numbers as points[0]", "intensity"]),
        ("[[1, 2, 3]]", "[[1, 2, 3], [1, 2]]", &["not 2 numbers as points[1]"]),
        ("[[1, 2, 3]]", "[1, 2, 3]", &["points: [x, y, z] of each, not a number"]),
        ("[[1, 2, 3]]", "[[1, 2, NaN]]", &["points: every number must be finite", "points[0]"]),
        ("[[1, 2, 3]]", "[[1, -Infinity, 2]]", &["points: every number must be finite"]),
        ("[0, 0, 0]", "[0, 0]", &["translation: 3 numbers are wanted, not 2: x, y, z"]),
        ("[0, 0, 0]", "[0, 0, NaN]", &["translation: every number must be finite"]),
        ("[0, 0, 0]", "{\"x\": 0}", &["translation: 3 numbers are wanted: x, y, z"]),
        ("[0, 0, 0]", "[\"0\", 0, 0]", &["translation: 3 numbers are wanted, not text"]),
        ("[0, 0, 0, 1]", "[0, 0, 0]", &["rotation: 4 numbers are wanted, not 3: the quaternion x, y, z, w"]),
        (
            "\"stamp_ns\": 1",
            "\"stamp_ns\": 1700000000.5",
            &["stamp_ns: a whole number of nanoseconds, not 1700000000.5"],
        ),
        ("\"points\"", "\"session\": NaN, \"points\"", &["session: every number must be finite"]),
        ("\"points\"", "\"colour\": 1, \"points\"", &["unknown field `colour`", "line 1"]),
        ("\"translation\"", "\"position\"", &["position"]),
    ];
    for (from, to, parts) in cases {
        let told = told(&good.replacen(from, to, 1));
        assert!(parts.iter().all(|part| told.contains(part)), "{to}: {told}");
    }
    let whole = format!("{:?}", [1e-4; 36]);
    let square = format!("{:?}", [[1e-4; 6]; 6]);
    let want = "covariance: 21 numbers are wanted, not 36: the upper triangle of the 6×6 matrix row by row";
    assert!(told(&good.replace(&diagonal(1e-4), &whole)).contains(want));
    assert!(told(&good.replace(&diagonal(1e-4), &square)).contains("not lists; write them in one list: the upper"));
    // A position's is of its place alone; text that holds the words of numbers is left alone.
    let seen = r#"{"stamp_ns": 1, "robot": "b", "position": [1, 2, 3], "covariance": [1, 0, 0, 1, 0, 0, 0, 1]}"#;
    let seen = position(Format::Json, seen.as_bytes()).unwrap_err().to_string();
    assert!(seen.contains("covariance: 6 numbers are wanted, not 8: the upper triangle of the 3×3"), "{seen}");
    let text = good.replace("\"points\"", r#""place": {"model": "NaN \" Infinity", "metric": "x"}, "points""#);
    assert!(told(&text).contains("unknown variant `x`"), "{}", told(&text));
    // A field's name is the sender's.
    let long = told(&good.replacen("\"points\"", &format!("\"a\\nb{}\": NaN, \"points\"", "c".repeat(9000)), 1));
    assert!(long.starts_with("JSON: a bccc") && long.len() < 600 && !long.contains('\n'), "{long}");
    let unknown = told(&good.replacen("\"points\"", "\"a\\nb\": 1, \"points\"", 1));
    assert!(unknown.contains("unknown field `a b`"), "{unknown}");
    // Sent without an encoding, which says postcard.
    for json in [good.clone(), format!(" \n{}", good.replace("[[1, 2, 3]]", "[[NaN, 2, 3]]"))] {
        for error in [
            keyframe(Format::Postcard, json.as_bytes()).unwrap_err(),
            sighting(Format::Postcard, json.as_bytes()).unwrap_err(),
            position(Format::Postcard, json.as_bytes()).unwrap_err(),
        ] {
            assert_eq!(error, ObservationError::Encoding);
            assert!(error.to_string().starts_with("this looks like JSON: state the encoding application/json"));
        }
    }
    assert!(matches!(keyframe(Format::Postcard, b"{1, 2}").unwrap_err(), ObservationError::Postcard(_)));
}

/// Every place of a value in a document, as the names and numbers that lead there.
fn places(value: &serde_json::Value, at: &mut Vec<String>, out: &mut Vec<Vec<String>>) {
    match value {
        serde_json::Value::Object(fields) => {
            for (name, value) in fields {
                at.push(name.clone());
                out.push(at.clone());
                places(value, at, out);
                at.pop();
            }
        }
        serde_json::Value::Array(values) => {
            for (k, value) in values.iter().enumerate() {
                at.push(k.to_string());
                out.push(at.clone());
                places(value, at, out);
                at.pop();
            }
        }
        _ => {}
    }
}

/// Whatever is wrong about a field, what is told names that field, and nothing else is blamed.
#[test]
fn what_is_told_names_the_very_field_that_is_wrong() {
    use serde_json::{Value, json};
    let up = UpMessage { direction: [0.0, 0.0, 1.0], sigma_rad: 0.02 };
    let messages = [
        serde_json::to_value(KeyframeMessage { up: Some(up), ..of_a_session() }).unwrap(),
        serde_json::to_value(of_landmarks()).unwrap(),
    ];
    let bad = [
        json!("soon"),
        json!(-1e300),
        json!(true),
        json!({"k": 1}),
        json!([[[1]]]),
        json!(null),
        json!([]),
        json!(0.5),
    ];
    let mut refused = 0;
    for message in &messages {
        assert!(keyframe(Format::Json, message.to_string().as_bytes()).is_ok());
        let mut all = Vec::new();
        places(message, &mut Vec::new(), &mut all);
        for (place, bad) in all.iter().flat_map(|place| bad.iter().map(move |bad| (place, bad))) {
            let mut broken = message.clone();
            let pointer = format!("/{}", place.join("/"));
            *broken.pointer_mut(&pointer).unwrap() = bad.clone();
            let Err(error) = keyframe(Format::Json, broken.to_string().as_bytes()) else { continue };
            refused += 1;
            let told = error.to_string();
            // The name that leads there, or that of what it is part of.
            let names: Vec<&str> =
                place.iter().map(String::as_str).filter(|name| name.parse::<usize>().is_err()).collect();
            let is_named = names.iter().any(|name| told.contains(name.trim_end_matches('s')));
            assert!(is_named, "{pointer} = {bad}: {told}");
        }
        // One that is missing, if it must be there, and one that nobody knows.
        for name in message.as_object().unwrap().keys() {
            let mut without = message.clone();
            without.as_object_mut().unwrap().remove(name);
            if let Err(error) = keyframe(Format::Json, without.to_string().as_bytes()) {
                assert!(error.to_string().contains(name.as_str()), "without {name}: {error}");
            }
        }
        let mut more = message.clone();
        more["velocity"] = Value::from(3);
        assert!(keyframe(Format::Json, more.to_string().as_bytes()).unwrap_err().to_string().contains("velocity"));
    }
    assert!(refused > 300, "{refused}");
}
