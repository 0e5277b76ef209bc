use super::*;

const KINECT: Camera = Camera { fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0 };

fn image([width, height]: [u32; 2], count: impl Fn(usize) -> u16) -> DepthImage {
    let counts = (0..(width * height) as usize).flat_map(|k| count(k).to_le_bytes());
    DepthImage::from_raw([width, height], &counts.collect::<Vec<u8>>()).unwrap()
}

fn millimetres() -> Counts {
    Counts::new(1e-3, None).unwrap()
}

#[test]
fn a_pixel_lies_where_the_camera_saw_it() {
    let seen = image([640, 480], |k| {
        if k == 240 * 640 + 320 {
            2000
        } else if k == 479 * 640 {
            1000
        } else {
            0
        }
    });
    let points = seen.points(&KINECT, &millimetres(), 1).unwrap();
    assert_eq!(points.len(), 2);
    assert_eq!(points[0], [0.0, 0.0, 2.0]);
    let corner = [-320.0 / 585.0, 239.0 / 585.0, 1.0];
    assert!(points[1].iter().zip(corner).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6), "{:?}", points[1]);
}

#[test]
fn raw_and_png_say_the_same() {
    let raw = image([64, 48], |k| 500 + k as u16);
    let mut png = Vec::new();
    let mut encoder = png::Encoder::new(&mut png, 64, 48);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let samples: Vec<u8> = raw.counts.iter().flat_map(|count| count.to_be_bytes()).collect();
    encoder.write_header().unwrap().write_image_data(&samples).unwrap();
    assert_eq!(DepthImage::from_png(&png), Ok(raw));
    assert!(matches!(DepthImage::from_png(&png[..png.len() / 2]), Err(DepthError::Png(_))));
}

#[test]
fn a_stride_leaves_ten_thousand_pixels_at_most() {
    for (size, stride) in [([100, 100], 1), ([101, 100], 2), ([640, 480], 6), ([1280, 720], 10), ([1920, 1080], 15)] {
        let seen = image(size, |_| 1000);
        assert_eq!(seen.stride(), stride, "{size:?}");
        let left = size[0].div_ceil(stride as u32) * size[1].div_ceil(stride as u32);
        assert!(left as usize <= PIXELS_USED_MAX, "{size:?}");
    }
}

#[test]
fn what_is_not_measured_is_left_out() {
    let seen = image([640, 480], |k| [0, 1, 299, 300, 4000, 4001, u16::MAX - 1, u16::MAX][k % 8]);
    let depths = |range| -> Vec<f32> {
        let counts = Counts::new(1e-3, range).unwrap();
        seen.points(&KINECT, &counts, 1).unwrap()[..6].iter().map(|p| p[2]).collect()
    };
    assert_eq!(depths(None), [0.001, 0.299, 0.3, 4.0, 4.001, 65.534]);
    assert_eq!(depths(Some([0.3, 4.0])), [0.3, 4.0, 0.3, 4.0, 0.3, 4.0]);
    assert_eq!(depths(Some([0.0, 1.0]))[..3], [0.001, 0.299, 0.3]);
    let dark = image([640, 480], |_| 0).points(&KINECT, &millimetres(), 1).unwrap_err();
    assert!(dark.to_string().contains("of 307200 pixels none shows") && dark.to_string().contains("0 to 0"), "{dark}");
}

#[test]
fn units_and_ranges_are_bounded() {
    for unit_m in [*UNIT_M.start(), 1e-3, *UNIT_M.end()] {
        assert!(Counts::new(unit_m, None).is_ok(), "{unit_m}");
    }
    for unit_m in [0.0, -1e-3, 0.99 * UNIT_M.start(), 1.01 * UNIT_M.end(), 1.0, 1000.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(Counts::new(unit_m, None), Err(DepthError::Unit(_))), "{unit_m}");
    }
    assert!(Counts::new(1e-3, Some([0.0, 0.1])).is_ok());
    for range in [[1.0, 1.0], [4.0, 0.3], [-0.1, 4.0], [f64::NAN, 4.0], [0.3, f64::NAN], [0.3, f64::INFINITY]] {
        assert!(matches!(Counts::new(1e-3, Some(range)), Err(DepthError::Range(_))), "{range:?}");
    }
}

#[test]
fn sizes_are_bounded_on_both_sides() {
    let raw = |size: [u32; 2], bytes: usize| DepthImage::from_raw(size, &vec![1; bytes]).map(drop);
    assert_eq!(raw([2048, 2048], 2 << 22), Ok(()));
    assert_eq!(raw([2049, 2048], 2), Err(DepthError::Pixels { width: 2049, height: 2048 }));
    assert_eq!(raw([u32::MAX, u32::MAX], 2), Err(DepthError::Pixels { width: u32::MAX, height: u32::MAX }));
    assert_eq!(raw([0, 4], 0), Err(DepthError::Pixels { width: 0, height: 4 }));
    assert_eq!(raw([4, 3], 24), Ok(()));
    for found in [0, 12, 23, 25, 48] {
        assert_eq!(raw([4, 3], found), Err(DepthError::Length { width: 4, height: 3, found, due: 24 }));
    }
}

#[test]
fn a_camera_must_be_able_to_take_the_image() {
    let seen = image([640, 480], |_| 1000);
    let taken = |camera: &Camera| seen.points(camera, &millimetres(), 6).is_ok();
    assert!(taken(&KINECT));
    // A wide angle (127° to the sides) and a telescope, and what is just beyond.
    assert!(taken(&Camera { fx: 161.0, fy: 161.0, ..KINECT }) && !taken(&Camera { fx: 159.0, fy: 159.0, ..KINECT }));
    assert!(
        taken(&Camera { fx: 1439.0, fy: 1439.0, ..KINECT }) && !taken(&Camera { fx: 1450.0, fy: 1450.0, ..KINECT })
    );
    assert!(taken(&Camera { cx: 193.0, ..KINECT }) && !taken(&Camera { cx: 191.0, ..KINECT }));
    assert!(taken(&Camera { cy: 335.0, ..KINECT }) && !taken(&Camera { cy: 337.0, ..KINECT }));
    // Intrinsics of an image of twice and of half the size.
    for by in [2.0, 0.5] {
        let Camera { fx, fy, cx, cy } = KINECT;
        assert!(!taken(&Camera { fx: fx * by, fy: fy * by, cx: cx * by, cy: cy * by }), "{by}");
    }
    for f in [0.0, -585.0, f64::NAN, f64::INFINITY] {
        assert!(!taken(&Camera { fx: f, ..KINECT }) && !taken(&Camera { fy: f, ..KINECT }), "{f}");
    }
    assert!(!taken(&Camera { cx: f64::NAN, ..KINECT }));
    let told = seen.points(&Camera { fx: 5850.0, ..KINECT }, &millimetres(), 6).unwrap_err().to_string();
    assert!(told.contains("5850") && told.contains("640 × 480") && told.contains("0.25 to 3"), "{told}");
}
