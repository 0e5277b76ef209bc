use super::super::{Format, KeyframeMessage, keyframe};
use super::*;
use merganser_protocol::submap::{CovarianceOf, Keyframe};

/// A wall two metres ahead, seen with 640 × 480 pixels.
fn wall() -> DepthMessage {
    let data = 2000_u16.to_le_bytes().repeat(640 * 480);
    DepthMessage {
        width: 640,
        height: 480,
        fx: 585.0,
        fy: 585.0,
        cx: 320.0,
        cy: 240.0,
        unit_m: 1e-3,
        range_m: None,
        t_body_camera: None,
        encoding: DepthEncoding::Raw,
        data: Data(data),
    }
}

fn of(depth: DepthMessage) -> KeyframeMessage {
    let mut covariance = [0.0; 21];
    [0, 6, 11, 15, 18, 20].into_iter().for_each(|place| covariance[place] = 1e-4);
    KeyframeMessage {
        stamp_ns: 1,
        translation: [0.0; 3],
        rotation: [0.0, 0.0, 0.0, 1.0],
        covariance,
        covariance_of: CovarianceOf::Motion,
        points: Vec::new(),
        landmarks: Vec::new(),
        place: None,
        depth: Some(depth),
        organised: false,
        session: None,
        up: None,
    }
}

fn taken(depth: DepthMessage) -> Result<Vec<[f32; 3]>, ObservationError> {
    keyframe(Format::Postcard, &postcard::to_stdvec(&of(depth)).unwrap()).map(|keyframe| keyframe.points)
}

#[test]
fn an_image_becomes_points_in_json_and_postcard() {
    let message = of(wall());
    let (json, postcard) = (serde_json::to_vec(&message).unwrap(), postcard::to_stdvec(&message).unwrap());
    assert!(postcard.len() < 640 * 480 * 2 + 400, "{} bytes", postcard.len());
    let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
    assert_eq!(a, b);
    assert_eq!(a.points.len(), 107 * 80, "every sixth pixel of every sixth row");
    let first = [-2.0 * 320.0 / 585.0, -2.0 * 240.0 / 585.0, 2.0];
    assert!(a.points[0].iter().zip(first).all(|(p, w)| (f64::from(*p) - w).abs() < 1e-6), "{:?}", a.points[0]);
    for len in [postcard.len() - 640 * 480, postcard.len() - 4] {
        assert!(keyframe(Format::Postcard, &postcard[..len]).is_err(), "cut to {len}");
    }
}

#[test]
fn json_may_leave_out_what_has_a_default() {
    let mut json = serde_json::to_value(of(wall())).unwrap();
    for field in ["points", "landmarks", "place", "organised"] {
        json.as_object_mut().unwrap().remove(field);
    }
    for field in ["range_m", "t_body_camera", "encoding"] {
        json["depth"].as_object_mut().unwrap().remove(field);
    }
    assert_eq!(keyframe(Format::Json, json.to_string().as_bytes()), Keyframe::try_from(of(wall())));
    json["depth"]["data"] = "no base64!".into();
    let told = keyframe(Format::Json, json.to_string().as_bytes()).unwrap_err().to_string();
    assert!(told.contains("depth.data is no padded base64"), "{told}");
    json["depth"]["colour"] = 1.into();
    let told = keyframe(Format::Json, json.to_string().as_bytes()).unwrap_err().to_string();
    assert!(told.contains("unknown field") || told.contains("base64"), "{told}");
}

#[test]
fn a_png_says_the_same() {
    let mut png = Vec::new();
    let mut encoder = png::Encoder::new(&mut png, 640, 480);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    encoder.write_header().unwrap().write_image_data(&2000_u16.to_be_bytes().repeat(640 * 480)).unwrap();
    let packed = DepthMessage { encoding: DepthEncoding::Png, data: Data(png), ..wall() };
    assert_eq!(taken(packed.clone()), taken(wall()));
    let told = taken(DepthMessage { width: 320, ..packed }).unwrap_err();
    assert_eq!(told, DepthError::Size { found: [640, 480], stated: [320, 480] }.into());
    let told = taken(DepthMessage { encoding: DepthEncoding::Png, ..wall() }).unwrap_err().to_string();
    assert!(told.starts_with("depth: PNG: "), "{told}");
}

#[test]
fn a_camera_sits_where_the_body_says() {
    // Looking along the body's x, half a metre up: the camera's x is the body's −y, its y the body's −z.
    let pose = CameraPose { translation: [0.0, 0.0, 0.5], rotation: [-0.5, 0.5, -0.5, 0.5] };
    let points = taken(DepthMessage { t_body_camera: Some(pose), ..wall() }).unwrap();
    let first = [2.0, 2.0 * 320.0 / 585.0, 0.5 + 2.0 * 240.0 / 585.0];
    assert!(points[0].iter().zip(first).all(|(p, w)| (f64::from(*p) - w).abs() < 1e-6), "{:?}", points[0]);
    let refused = |pose| taken(DepthMessage { t_body_camera: Some(pose), ..wall() }).unwrap_err();
    assert_eq!(refused(CameraPose { rotation: [0.0; 4], ..pose }), ObservationError::CameraRotation);
    let nowhere = CameraPose { translation: [0.0, f64::NAN, 0.0], ..pose };
    assert_eq!(refused(nowhere), ObservationError::Number("depth.t_body_camera.translation"));
}

#[test]
fn each_mistake_is_told() {
    let told = |change: &dyn Fn(&mut DepthMessage)| {
        let mut depth = wall();
        change(&mut depth);
        taken(depth).unwrap_err().to_string()
    };
    type Change<'a> = &'a dyn Fn(&mut DepthMessage);
    let cases: [(Change<'_>, &str); 10] = [
        (&|d| d.data.0.truncate(640 * 480), "307200 bytes for 640 × 480"),
        (&|d| d.width = 0, "one to 4194304 pixels"),
        (&|d| d.width = u32::MAX, "one to 4194304 pixels"),
        (&|d| d.fx = 58.5, "no camera of focal lengths 58.5 and 585"),
        (&|d| d.cy = 480.0, "principal point 320, 480"),
        (&|d| d.unit_m = 0.0, "unit_m = 0"),
        (&|d| d.unit_m = 1.0, "0.001 for millimetres"),
        (&|d| d.range_m = Some([4.0, 0.3]), "range_m = [4.0, 0.3]"),
        (&|d| d.range_m = Some([2.5, 4.0]), "of 307200 pixels none shows a depth of 2.5 to 4 m"),
        (&|d| d.data.0.fill(0), "the counts go from 0 to 0"),
    ];
    for (change, wanted) in cases {
        let told = told(change);
        assert!(told.starts_with("depth: ") && told.contains(wanted), "{told}\nwanted {wanted}");
    }
    let both = KeyframeMessage { points: vec![[1.0; 3]], ..of(wall()) };
    assert_eq!(Keyframe::try_from(both), Err(ObservationError::Both));
}
