//! Laws of every message: it is read back as it was written, in both serialisations and both byte orders; every
//! shortening is refused; arbitrary bytes are refused or read, and take no more memory than their length allows.

use super::{CDR_HEADER_LEN, Field, Message, Serialization, WireError, plain_type};
use crate::msg::{
    CameraInfo, Image, Imu, LaserScan, Odometry, PointCloud2, PoseStamped, PoseWithCovarianceStamped, TfMessage,
};
use hiroz_cdr::{BigEndian, CdrWriter};
use proptest::prelude::*;

/// What a message is read from to be any: fields are drawn from these bytes in turn, lengths are small, and text is
/// text.
struct Drawn<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Drawn<'_> {
    fn next(&mut self) -> u8 {
        self.at += 1;
        self.bytes[self.at % self.bytes.len()]
    }
}

/// Numbers that are drawn are finite and not zero, so that a field in the wrong place shows.
impl<'a> super::Source<'a> for Drawn<'a> {
    const IS_ROS1: bool = false;

    fn left(&self) -> usize {
        usize::MAX
    }

    fn raw(&mut self, _: &'static str, count: usize) -> Result<&'a [u8], WireError> {
        self.at += 1;
        let text: &'static [u8] = b"frames/of_some_robot, and more: abcdefghijklmnopqrstuvwxyz";
        Ok(&text[self.at % 7..][..count])
    }

    fn u8(&mut self, _: &'static str) -> Result<u8, WireError> {
        Ok(self.next() % 2)
    }

    fn u16(&mut self, _: &'static str) -> Result<u16, WireError> {
        Ok(u16::from(self.next()))
    }

    /// Lengths are such numbers, too; as a float it is next to nothing, and told apart all the same.
    fn u32(&mut self, _: &'static str) -> Result<u32, WireError> {
        Ok(u32::from(self.next() % 12))
    }

    fn u64(&mut self, _: &'static str) -> Result<u64, WireError> {
        Ok((f64::from(self.next()) - 99.5).to_bits())
    }
}

fn drawn<M: Message>(bytes: &[u8]) -> M {
    M::read(&mut Drawn { bytes, at: 0 }, M::TYPE).unwrap()
}

fn big_endian<M: Field>(message: &M) -> Vec<u8> {
    let mut bytes = vec![0, 0, 0, 0];
    message.write(&mut CdrWriter::<BigEndian>::new(&mut bytes));
    bytes
}

fn laws<M: Message + PartialEq + std::fmt::Debug>(bytes: &[u8]) -> Result<(), TestCaseError> {
    let message: M = drawn(bytes);
    for (serialization, written) in [
        (Serialization::Cdr, message.encode(Serialization::Cdr)),
        (Serialization::Ros1, message.encode(Serialization::Ros1)),
        (Serialization::Cdr, big_endian(&message)),
    ] {
        let read = M::decode(serialization, &written);
        prop_assert_eq!(read.as_ref(), Ok(&message));
        for cut in 0..written.len() {
            prop_assert!(M::decode(serialization, &written[..cut]).is_err(), "{} cut at {cut}", M::TYPE);
        }
        let longer = [written.as_slice(), &[0; 4]].concat();
        prop_assert_eq!(M::decode(serialization, &longer), Err(WireError::Trailing(4)));
    }
    for serialization in [Serialization::Cdr, Serialization::Ros1] {
        let _ = M::decode(serialization, bytes);
        let _ = M::decode(serialization, &[&[0, 1, 0, 0], bytes].concat());
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn each_message_is_read_as_it_was_written(bytes in prop::collection::vec(any::<u8>(), 1..300)) {
        laws::<Odometry>(&bytes)?;
        laws::<PoseStamped>(&bytes)?;
        laws::<PoseWithCovarianceStamped>(&bytes)?;
        laws::<TfMessage>(&bytes)?;
        laws::<LaserScan>(&bytes)?;
        laws::<PointCloud2>(&bytes)?;
        laws::<Image>(&bytes)?;
        laws::<CameraInfo>(&bytes)?;
        laws::<Imu>(&bytes)?;
    }
}

/// As ROS 2 (Humble) wrote it: `std_msgs/Header` of frame "odom" at 1663967375.744427509 s, child "base_link", and so
/// on.
#[test]
fn alignment_is_counted_from_behind_the_header() {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend(1_663_967_375_i32.to_le_bytes());
    bytes.extend(744_427_509_u32.to_le_bytes());
    bytes.extend(b"\x05\0\0\0odom\0");
    bytes.extend([0; 7]); // to 24, where eight bytes divide
    (1..=7).for_each(|k| bytes.extend(f64::from(k).to_le_bytes()));
    let pose = PoseStamped::decode(Serialization::Cdr, &bytes).unwrap();
    assert_eq!((pose.header.stamp_ns, pose.header.frame()), (1_663_967_375_744_427_509, "odom"));
    assert_eq!((pose.pose.position.x, pose.pose.orientation.w), (1.0, 7.0));
    assert_eq!(pose.encode(Serialization::Cdr), bytes);
}

#[test]
fn claims_beyond_the_bytes_are_refused_before_anything_is_allocated() {
    let scan: LaserScan = drawn(&[7, 9, 11]);
    let mut bytes = scan.encode(Serialization::Ros1);
    let ranges = bytes.len() - 4 * (scan.ranges.len() + scan.intensities.len()) - 8;
    bytes[ranges..ranges + 4].copy_from_slice(&u32::MAX.to_le_bytes());
    let error = LaserScan::decode(Serialization::Ros1, &bytes).unwrap_err();
    assert!(matches!(error, WireError::Count { field: "ranges", count: u32::MAX, .. }), "{error}");
    // As many as there are bytes for, and one more.
    let fitting = |count: u32| {
        let mut bytes = count.to_le_bytes().to_vec();
        bytes.extend([0; 40]);
        Vec::<f64>::read(&mut super::Ros1Reader::new(&bytes), "d")
    };
    assert_eq!(fitting(5).unwrap().len(), 5);
    assert_eq!(fitting(6), Err(WireError::Count { field: "d", count: 6, left: 40 }));
}

#[test]
fn what_is_no_plain_cdr_is_told() {
    let mut bytes = drawn::<Imu>(&[1]).encode(Serialization::Cdr);
    bytes[1] = 3;
    let error = Imu::decode(Serialization::Cdr, &bytes).unwrap_err();
    assert_eq!(error, WireError::Encapsulation([0, 3]));
    assert!(error.to_string().contains("[00, 03]"));
    assert!(matches!(Imu::decode(Serialization::Cdr, &bytes[..CDR_HEADER_LEN - 1]), Err(WireError::Short { .. })));
    let long = vec![0; crate::limits::MESSAGE_BYTES_MAX + 1];
    assert_eq!(Imu::decode(Serialization::Cdr, &long), Err(WireError::Long(long.len())));
    let error = Imu::decode(Serialization::Cdr, &long[1..]).unwrap_err();
    assert!(matches!(error, WireError::Trailing(_)), "the longest is looked at: {error}");
    let text = [&4_u32.to_le_bytes()[..], &[0xff, 0xfe, 0xfd, 0]].concat();
    assert!(matches!(String::read(&mut super::Ros1Reader::new(&text), "frame"), Err(WireError::Value { .. })));
    assert!(matches!(bool::read(&mut super::Ros1Reader::new(&[2]), "is_dense"), Err(WireError::Value { .. })));
}

#[test]
fn names_of_types_are_one_in_both() {
    for name in ["nav_msgs/msg/Odometry", "nav_msgs/Odometry"] {
        assert_eq!(plain_type(name), Odometry::TYPE);
    }
    assert_eq!(plain_type("tf/tfMessage"), TfMessage::TYPE);
}
