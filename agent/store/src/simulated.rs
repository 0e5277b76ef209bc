//! A disk in memory that fails as it is told: writes that no sync confirmed are lost or torn by a power cut, a sync can
//! lie, there can be no room, operations can fail, bits can flip at rest, and an old image can come back. Everything it
//! does is a function of the numbers it is given, so that a simulation replays.
//!
//! A failed sync follows what kernels do: part of what was written reaches the disk, none of the rest ever will by a
//! later sync, and reading still shows all of it until the power is cut.

use crate::Medium;
use redb::{Builder, Database, DatabaseError, StorageBackend};
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What a disk writes in one piece.
pub const SECTOR: usize = 512;

/// The database's header: it was written when the file was made, so there is room for it on a full disk, too.
const FIRST_PAGE: u64 = 4096;

/// See the module. Clones share the disk.
#[derive(Clone, Default)]
pub struct Disk(Arc<Mutex<Platter>>);

#[derive(Default)]
struct Platter {
    main: Arc<Mutex<Image>>,
    spare: Arc<Mutex<Image>>,
    faults: Arc<Mutex<Faults>>,
}

/// What is wrong with a disk at present, and what it did.
#[derive(Clone, Debug, Default)]
pub struct Faults {
    /// No room: writes and growth fail.
    pub full: bool,
    /// So many operations from now, and for as many as [`Faults::errors`], writes and syncs fail, and reads if
    /// [`Faults::reads`].
    pub errors_after: u64,
    /// How many operations will fail.
    pub errors: u64,
    /// Reads fail with the rest.
    pub reads: bool,
    /// Syncs say that they did, and do nothing.
    pub lies: bool,
    /// After so many writes and syncs the power is gone: all fail, until [`Disk::cut`].
    pub dies_after: Option<u64>,
    /// Chooses what a failed sync keeps.
    pub seed: u64,
    /// Writes and syncs refused for want of room.
    pub refused_full: u64,
    /// Writes and syncs that failed.
    pub refused_error: u64,
    /// Reads that failed.
    pub refused_reads: u64,
    /// Syncs that lied.
    pub lied: u64,
    /// The power went in the middle of an operation.
    pub died: bool,
}

#[derive(Default)]
struct Image {
    /// What reading shows.
    seen: Vec<u8>,
    /// What a power cut leaves for sure.
    durable: Vec<u8>,
    /// Written and not yet synced.
    pending: Vec<(usize, Vec<u8>)>,
}

/// A whole disk at one moment, as it would be after a power cut that loses what was not synced.
#[derive(Clone)]
pub struct Picture(Vec<u8>);

impl Picture {
    /// Its bytes, to be spoiled.
    pub fn bytes(&mut self) -> &mut [u8] {
        &mut self.0
    }
}

/// What a power cut did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cut {
    /// Writes that no sync had confirmed and that are gone.
    pub lost: u64,
    /// Those of which some sectors are there and some are not.
    pub torn: u64,
}

impl Disk {
    /// Changes what is wrong with it.
    pub fn with_faults<T>(&self, change: impl FnOnce(&mut Faults) -> T) -> T {
        let faults = lock(&self.0).faults.clone();
        change(&mut lock(&faults))
    }

    /// Cuts the power: of what was not synced, each write is lost, there, or torn. Open handles are dead.
    pub fn cut(&self, seed: u64) -> Cut {
        let mut draw = Draw(seed);
        let mut platter = lock(&self.0);
        let mut cut = Cut::default();
        let after = lock(&platter.main).after_cut(&mut draw, &mut cut);
        platter.replace(Image::of(after));
        let mut faults = lock(&platter.faults);
        (faults.dies_after, faults.died, faults.errors) = (None, false, 0);
        cut
    }

    /// Ends all handles without loss: the process was killed, the machine runs on.
    pub fn let_go(&self) {
        let mut platter = lock(&self.0);
        let image = std::mem::take(&mut *lock(&platter.main));
        platter.replace(image);
    }

    /// An empty disk in its place.
    pub fn wipe(&self) {
        lock(&self.0).replace(Image::default());
    }

    /// Flips one bit, if there is any.
    pub fn flip(&self, seed: u64) -> bool {
        let mut draw = Draw(seed);
        let main = lock(&self.0).main.clone();
        let mut image = lock(&main);
        // Where something was written: zeros at rest are mostly free space.
        let Some(at) = (0..100_000).map(|_| draw.below(image.seen.len())).find(|at| image.seen.get(*at) != Some(&0))
        else {
            return false;
        };
        let bit = 1 << draw.below(8);
        for bytes in [true, false] {
            let bytes = if bytes { &mut image.seen } else { &mut image.durable };
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= bit;
            }
        }
        !image.seen.is_empty()
    }

    /// What is on it for sure.
    pub fn picture(&self) -> Picture {
        Picture(lock(&lock(&self.0).main).durable.clone())
    }

    /// Puts an image on it. Open handles are dead.
    pub fn restore(&self, picture: &Picture) {
        lock(&self.0).replace(Image::of(picture.0.clone()));
    }

    /// Bytes of the database.
    pub fn len(&self) -> u64 {
        lock(&lock(&self.0).main).seen.len() as u64
    }

    /// Whether there is no database.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl fmt::Debug for Disk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Disk({} bytes)", self.len())
    }
}

impl Medium for Disk {
    fn path(&self) -> &Path {
        Path::new("simulated")
    }

    fn create(&self, builder: &Builder) -> Result<Database, DatabaseError> {
        let platter = lock(&self.0);
        let handle = Handle { image: platter.main.clone(), faults: platter.faults.clone() };
        drop(platter);
        builder.create_with_backend(handle)
    }

    fn create_spare(&self, builder: &Builder) -> Result<Database, DatabaseError> {
        let mut platter = lock(&self.0);
        platter.spare = Arc::default();
        let handle = Handle { image: platter.spare.clone(), faults: platter.faults.clone() };
        drop(platter);
        builder.create_with_backend(handle)
    }

    fn promote_spare(&self, _keep: bool) -> io::Result<Option<PathBuf>> {
        let mut platter = lock(&self.0);
        lock(&platter.faults).operate()?;
        platter.main = std::mem::take(&mut platter.spare);
        Ok(None)
    }

    /// An empty disk is one that was never written.
    fn is_emptied(&self) -> io::Result<bool> {
        Ok(false)
    }

    fn bytes(&self) -> io::Result<Box<dyn io::Read + '_>> {
        let platter = lock(&self.0);
        lock(&platter.faults).read()?;
        Ok(Box::new(io::Cursor::new(lock(&platter.main).seen.clone())))
    }
}

impl Platter {
    /// Another image; what old handles still do touches neither it nor the faults.
    fn replace(&mut self, image: Image) {
        self.main = Arc::new(Mutex::new(image));
        self.spare = Arc::default();
        let faults = lock(&self.faults).clone();
        self.faults = Arc::new(Mutex::new(faults));
    }
}

impl Image {
    fn of(bytes: Vec<u8>) -> Self {
        Self { seen: bytes.clone(), durable: bytes, pending: Vec::new() }
    }

    fn sync(&mut self) {
        self.durable.resize(self.seen.len(), 0);
        for (offset, data) in self.pending.drain(..) {
            write(&mut self.durable, offset, &data);
        }
    }

    fn after_cut(&self, draw: &mut Draw, cut: &mut Cut) -> Vec<u8> {
        let mut left = self.durable.clone();
        if draw.below(2) == 0 && self.seen.len() > left.len() {
            left.resize(self.seen.len(), 0);
        }
        for (offset, data) in &self.pending {
            match draw.below(3) {
                0 => cut.lost += 1,
                1 => write(&mut left, *offset, data),
                _ => {
                    cut.torn += 1;
                    for (k, sector) in data.chunks(SECTOR).enumerate() {
                        if draw.below(2) == 0 {
                            write(&mut left, offset + k * SECTOR, sector);
                        }
                    }
                }
            }
        }
        left
    }
}

impl Faults {
    /// One write or sync: does it fail?
    fn operate(&mut self) -> io::Result<()> {
        if let Some(left) = &mut self.dies_after {
            if *left == 0 {
                self.died = true;
                return Err(io::Error::other("the power is gone"));
            }
            *left -= 1;
        }
        let fails = self.fails();
        self.refused_error += u64::from(fails.is_err());
        fails
    }

    /// One read: does it fail?
    fn read(&mut self) -> io::Result<()> {
        if !self.reads {
            return Ok(());
        }
        let fails = self.fails();
        self.refused_reads += u64::from(fails.is_err());
        fails
    }

    fn fails(&mut self) -> io::Result<()> {
        if self.errors_after > 0 {
            self.errors_after -= 1;
        } else if self.errors > 0 {
            self.errors -= 1;
            return Err(io::Error::other("input/output error"));
        }
        Ok(())
    }

    fn take_room(&mut self) -> io::Result<()> {
        if self.full {
            self.refused_full += 1;
            return Err(io::ErrorKind::StorageFull.into());
        }
        Ok(())
    }
}

/// What the database holds on to.
struct Handle {
    image: Arc<Mutex<Image>>,
    faults: Arc<Mutex<Faults>>,
}

impl fmt::Debug for Handle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Handle")
    }
}

impl StorageBackend for Handle {
    fn len(&self) -> io::Result<u64> {
        Ok(lock(&self.image).seen.len() as u64)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        lock(&self.faults).read()?;
        let image = lock(&self.image);
        let start = usize::try_from(offset).map_err(io::Error::other)?;
        let end = start.checked_add(out.len()).ok_or(io::ErrorKind::InvalidInput)?;
        out.copy_from_slice(image.seen.get(start..end).ok_or(io::ErrorKind::UnexpectedEof)?);
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        let mut faults = lock(&self.faults);
        faults.operate()?;
        let mut image = lock(&self.image);
        let len = usize::try_from(len).map_err(io::Error::other)?;
        if len > image.seen.len() {
            faults.take_room()?;
        }
        image.seen.resize(len, 0);
        Ok(())
    }

    fn sync_data(&self) -> io::Result<()> {
        let mut faults = lock(&self.faults);
        let mut image = lock(&self.image);
        if let Err(error) = faults.operate() {
            if !faults.died {
                let mut draw = Draw(faults.seed);
                faults.seed = draw.next();
                image.durable = image.after_cut(&mut draw, &mut Cut::default());
                image.pending.clear();
            }
            return Err(error);
        }
        if faults.lies {
            faults.lied += 1;
        } else {
            image.sync();
        }
        Ok(())
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        let mut faults = lock(&self.faults);
        faults.operate()?;
        if offset >= FIRST_PAGE {
            faults.take_room()?;
        }
        let offset = usize::try_from(offset).map_err(io::Error::other)?;
        let mut image = lock(&self.image);
        write(&mut image.seen, offset, data);
        image.pending.push((offset, data.to_vec()));
        Ok(())
    }
}

fn write(bytes: &mut Vec<u8>, offset: usize, data: &[u8]) {
    let end = offset + data.len();
    if bytes.len() < end {
        bytes.resize(end, 0);
    }
    bytes[offset..end].copy_from_slice(data);
}

/// A poisoned lock guards bytes that any moment may show.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// SplitMix64.
struct Draw(u64);

impl Draw {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }
}
