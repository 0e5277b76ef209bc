//! Place descriptors of the user's own: a file of rows of numbers, one for each keyframe.

use super::error::{Problem, RecordingError, on};
use crate::manifest::PlaceFormat;
use merganser_protocol::submap::place::{VECTOR_LEN_MAX, VECTOR_LEN_MIN};
use merganser_protocol::submap::{PlaceDescriptor, PlaceError};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Bytes of a number.
const NUMBER_LEN: usize = size_of::<f32>();

/// Sees to it that the file holds a row for each of so many keyframes.
pub(super) fn check(path: &Path, format: &PlaceFormat, keyframes: usize) -> Result<(), RecordingError> {
    if !(VECTOR_LEN_MIN..=VECTOR_LEN_MAX).contains(&format.numbers) {
        return Err(Problem::Place(PlaceError::Length(format.numbers)).of(path));
    }
    let found = on(path, std::fs::metadata(path))?.len();
    let expected = keyframes as u64 * (format.numbers * NUMBER_LEN) as u64;
    if found == expected { Ok(()) } else { Err(Problem::PlacesLength { found, expected }.of(path)) }
}

/// What is said of keyframe `index`.
pub(super) fn read(path: &Path, format: &PlaceFormat, index: usize) -> Result<Option<PlaceDescriptor>, RecordingError> {
    let mut row = vec![0; format.numbers * NUMBER_LEN];
    let mut file = on(path, File::open(path))?;
    on(path, file.seek(SeekFrom::Start(index as u64 * row.len() as u64)))?;
    on(path, file.read_exact(&mut row))?;
    let numbers: Vec<f32> = row.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    if numbers.iter().all(|x| x.is_nan()) {
        return Ok(None);
    }
    let refused = |error: PlaceError| Problem::Data(format!("row {index} (counted from 0): {error}")).of(path);
    PlaceDescriptor::new(&format.model, format.metric, numbers).map(Some).map_err(refused)
}

/// The rows of a recording that is being written.
#[derive(Debug, Default)]
pub(super) struct Rows {
    format: Option<PlaceFormat>,
    /// Keyframes before the first that has a row.
    without: usize,
    bytes: Vec<u8>,
}

impl Rows {
    /// Adds a row, of the kind of those before it.
    pub(super) fn push(&mut self, place: Option<&PlaceDescriptor>) -> Result<(), Problem> {
        let format = place.map(|place| PlaceFormat {
            model: place.model().into(),
            metric: place.metric(),
            numbers: place.vector().len(),
        });
        if self.format.is_none() && format.is_some() {
            self.format.clone_from(&format);
            (0..core::mem::take(&mut self.without)).for_each(|_| self.put(None));
        } else if format.is_some() && format != self.format {
            return Err(Problem::Data("place vectors of different kinds cannot be recorded together".into()));
        }
        self.put(place.map(PlaceDescriptor::vector));
        Ok(())
    }

    fn put(&mut self, vector: Option<&[f32]>) {
        match (&self.format, vector) {
            (_, Some(vector)) => self.bytes.extend(vector.iter().flat_map(|x| x.to_le_bytes())),
            (Some(format), None) => self.bytes.extend(f32::NAN.to_le_bytes().repeat(format.numbers)),
            (None, None) => self.without += 1,
        }
    }

    /// What the rows are, and they themselves, if any keyframe had one.
    pub(super) fn finish(&self) -> Option<(PlaceFormat, &[u8])> {
        self.format.clone().map(|format| (format, &self.bytes[..]))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{KEYFRAMES, MANIFEST, PLACES, Recording, Writer};
    use super::*;
    use crate::manifest::{CloudFormat, Manifest};
    use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
    use merganser_protocol::submap::place::Metric;
    use merganser_protocol::submap::{CovarianceOf, Keyframe};
    use merganser_protocol::time::Stamp;

    fn place(vector: [f32; 3]) -> PlaceDescriptor {
        PlaceDescriptor::new("net", Metric::Euclidean, vector.to_vec()).unwrap()
    }

    fn write(folder: &Path, places: &[Option<PlaceDescriptor>]) -> Result<(), RecordingError> {
        let manifest = Manifest {
            format: String::new(),
            version: 0,
            robot: merganser_protocol::ids::Name::new("alpha").unwrap(),
            sensor: "none".into(),
            covariance_of: CovarianceOf::Motion,
            clouds: CloudFormat::XyzBin,
            keyframes: 0,
            origin: String::new(),
            unit_m: None,
            begins_ns: None,
            places: None,
            config: merganser_protocol::config::Config::default(),
        };
        let mut writer = Writer::create(folder, manifest)?;
        for (stamp, place) in (0..).zip(places) {
            let covariance = Covariance::from_sigmas([0.1; 6]).unwrap();
            let keyframe = Keyframe {
                stamp: Stamp(stamp),
                pose: PoseWithCovariance { pose: Se3::identity(), covariance },
                covariance_of: CovarianceOf::Motion,
                session: None,
                points: vec![[1.0; 3]],
                marks: vec![],
                place: place.clone(),
                up: None,
            };
            writer.push(&keyframe, None)?;
        }
        writer.finish()
    }

    fn refused(folder: &Path) -> String {
        Recording::open(folder).unwrap_err().to_string()
    }

    #[test]
    fn places_read_back_as_they_were_written() {
        let dir = tempfile::tempdir().unwrap();
        let places = [None, Some(place([1.0, -2.0, 0.5])), None, Some(place([0.0, 7.0, 1e-3]))];
        write(dir.path(), &places).unwrap();
        let recording = Recording::open(dir.path()).unwrap();
        for (index, place) in places.iter().enumerate() {
            assert_eq!(recording.keyframe(index).unwrap().place, *place, "{index}");
        }
        write(dir.path(), &[None, None]).unwrap();
        assert_eq!(Recording::open(dir.path()).unwrap().manifest().places, None);
        let other = PlaceDescriptor::new("net", Metric::Cosine, vec![1.0; 3]).unwrap();
        let mixed = write(dir.path(), &[Some(place([1.0; 3])), Some(other)]).unwrap_err().to_string();
        assert!(mixed.contains("different kinds"), "{mixed}");
    }

    #[test]
    fn rows_that_do_not_fit_are_refused_by_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(PLACES);
        write(dir.path(), &[Some(place([1.0; 3])), Some(place([2.0; 3]))]).unwrap();
        let rows = std::fs::read(&path).unwrap();
        std::fs::write(&path, &rows[1..]).unwrap();
        let text = refused(dir.path());
        assert!(text.contains("places.f32: 23 bytes instead of 24"), "{text}");
        std::fs::write(&path, [&rows[..20], &f32::INFINITY.to_le_bytes()].concat()).unwrap();
        let recording = Recording::open(dir.path()).unwrap();
        assert!(recording.keyframe(0).is_ok());
        let text = recording.keyframe(1).unwrap_err().to_string();
        assert!(text.contains("places.f32: row 1 (counted from 0): number 2"), "{text}");
        std::fs::remove_file(&path).unwrap();
        assert!(refused(dir.path()).contains(PLACES));
        let manifest = std::fs::read_to_string(dir.path().join(MANIFEST)).unwrap();
        std::fs::write(dir.path().join(MANIFEST), manifest.replace("numbers = 3", "numbers = 1")).unwrap();
        assert!(refused(dir.path()).contains("places.numbers: a place vector has 2 to 16384 numbers, not 1"));
        assert!(dir.path().join(KEYFRAMES).is_file());
    }
}
