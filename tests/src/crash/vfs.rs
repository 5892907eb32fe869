//! SQLite on a [`Disk`]: a virtual file system under the name [`NAME`], one disk a directory.
//!
//! Locks and the index of the write-ahead log are kept as the trait asks for them, so that a store's writer and its
//! readers work as they do on a real disk. Temporary files are not part of the disk: nothing of them outlives a cut.

use super::disk::{Disk, Refused};
use sqlite_vfs::{
    DatabaseHandle, LockKind, OpenAccess, OpenKind, OpenOptions, Vfs,
    wip::{WalIndex, WalIndexLock},
};
use std::{
    collections::HashMap,
    io::{Error, ErrorKind},
    ops::Range,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard, Once, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

/// The name to open a store with.
pub const NAME: &str = "power-cut";

/// Bytes of a region of the log's index.
const REGION_BYTES: usize = 32768;

static MOUNTED: Mutex<Option<HashMap<PathBuf, Arc<Mutex<Volume>>>>> = Mutex::new(None);
static NUMBER: AtomicU64 = AtomicU64::new(1);

/// A disk and who has what of it open.
#[derive(Debug, Default)]
struct Volume {
    disk: Disk,
    /// Who holds which lock, by file name.
    locks: HashMap<String, HashMap<u64, LockKind>>,
    indices: HashMap<String, Arc<Mutex<Index>>>,
}

/// Puts a disk where a directory is; it is there until it is unmounted.
///
/// # Panics
/// SQLite does not take the file system.
pub fn mount(directory: &Path, disk: Disk) {
    static REGISTERED: Once = Once::new();
    REGISTERED.call_once(|| sqlite_vfs::register(NAME, PowerCut, false).expect("a file system that SQLite takes"));
    let volume = Volume { disk, ..Volume::default() };
    let mut mounted = lock(&MOUNTED);
    mounted.get_or_insert_default().insert(directory.to_owned(), Arc::new(Mutex::new(volume)));
}

/// Takes the disk of a directory away, and gives it.
///
/// # Panics
/// There is none.
pub fn unmount(directory: &Path) -> Disk {
    let volume = lock(&MOUNTED).as_mut().and_then(|mounted| mounted.remove(directory)).expect("a mounted disk");
    std::mem::take(&mut lock(&volume).disk)
}

/// Works on the disk of a directory.
///
/// # Panics
/// There is none.
pub fn with_disk<T>(directory: &Path, work: impl FnOnce(&mut Disk) -> T) -> T {
    let volume = volume(directory).expect("a mounted disk");
    work(&mut lock(&volume).disk)
}

fn volume(directory: &Path) -> Option<Arc<Mutex<Volume>>> {
    lock(&MOUNTED).as_ref()?.get(directory).cloned()
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn refused(refused: Refused) -> Error {
    match refused {
        Refused::Broken => Error::other("the disk is broken"),
        // What SQLite is told by this is that the disk is full.
        Refused::Full => ErrorKind::WriteZero.into(),
    }
}

/// Directory and name of a file; temporary files have no directory.
fn split(path: &str) -> Option<(Arc<Mutex<Volume>>, String)> {
    let path = Path::new(path);
    Some((volume(path.parent()?)?, path.file_name()?.to_str()?.to_owned()))
}

struct PowerCut;

impl Vfs for PowerCut {
    type Handle = Handle;

    fn open(&self, path: &str, options: OpenOptions) -> Result<Handle, Error> {
        let id = NUMBER.fetch_add(1, Ordering::Relaxed);
        let Some((volume, name)) = split(path) else {
            return Ok(Handle { id, place: Place::Temporary(Vec::new()) });
        };
        let file = {
            let mut volume = lock(&volume);
            match (volume.disk.find(&name), options.access) {
                (Some(_), OpenAccess::CreateNew) => return Err(ErrorKind::AlreadyExists.into()),
                (Some(file), _) => file,
                (None, OpenAccess::Create | OpenAccess::CreateNew) => {
                    let is_log = matches!(options.kind, OpenKind::Wal | OpenKind::MainJournal | OpenKind::SuperJournal);
                    volume.disk.create(&name, is_log)
                }
                (None, OpenAccess::Read | OpenAccess::Write) => return Err(ErrorKind::NotFound.into()),
            }
        };
        Ok(Handle { id, place: Place::Disk { volume, name, file } })
    }

    fn delete(&self, path: &str) -> Result<(), Error> {
        let deleted = split(path).is_some_and(|(volume, name)| lock(&volume).disk.delete(&name));
        if deleted { Ok(()) } else { Err(ErrorKind::NotFound.into()) }
    }

    fn exists(&self, path: &str) -> Result<bool, Error> {
        Ok(split(path).is_some_and(|(volume, name)| lock(&volume).disk.find(&name).is_some()))
    }

    fn temporary_name(&self) -> String {
        format!("temporary-{}", NUMBER.fetch_add(1, Ordering::Relaxed))
    }

    fn random(&self, buffer: &mut [i8]) {
        for byte in buffer {
            *byte = (NUMBER.fetch_add(1, Ordering::Relaxed).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as i8;
        }
    }

    fn sleep(&self, duration: Duration) -> Duration {
        std::thread::sleep(duration);
        duration
    }
}

/// An open file.
#[derive(Debug)]
struct Handle {
    id: u64,
    place: Place,
}

#[derive(Debug)]
enum Place {
    Temporary(Vec<u8>),
    Disk { volume: Arc<Mutex<Volume>>, name: String, file: usize },
}

impl Drop for Handle {
    fn drop(&mut self) {
        if let Place::Disk { volume, name, .. } = &self.place {
            let mut volume = lock(volume);
            if let Some(holders) = volume.locks.get_mut(name) {
                holders.remove(&self.id);
            }
            if let Some(index) = volume.indices.get(name) {
                lock(index).locks.retain(|(holder, _), _| *holder != self.id);
            }
        }
    }
}

impl DatabaseHandle for Handle {
    type WalIndex = IndexHandle;

    fn size(&self) -> Result<u64, Error> {
        Ok(match &self.place {
            Place::Temporary(content) => content.len() as u64,
            Place::Disk { volume, file, .. } => lock(volume).disk.len(*file) as u64,
        })
    }

    fn read_exact_at(&mut self, out: &mut [u8], offset: u64) -> Result<(), Error> {
        let read = match &self.place {
            Place::Temporary(content) => {
                let there = content.get(offset as usize..).unwrap_or_default();
                let n = there.len().min(out.len());
                out[..n].copy_from_slice(&there[..n]);
                out[n..].fill(0);
                n
            }
            Place::Disk { volume, file, .. } => lock(volume).disk.read(*file, offset as usize, out).map_err(refused)?,
        };
        if read == out.len() { Ok(()) } else { Err(ErrorKind::UnexpectedEof.into()) }
    }

    fn write_all_at(&mut self, data: &[u8], offset: u64) -> Result<(), Error> {
        match &mut self.place {
            Place::Temporary(content) => {
                let (offset, end) = (offset as usize, offset as usize + data.len());
                content.resize(content.len().max(end), 0);
                content[offset..end].copy_from_slice(data);
                Ok(())
            }
            Place::Disk { volume, file, .. } => lock(volume).disk.write(*file, offset as usize, data).map_err(refused),
        }
    }

    fn sync(&mut self, _data_only: bool) -> Result<(), Error> {
        match &self.place {
            Place::Temporary(_) => Ok(()),
            Place::Disk { volume, file, .. } => lock(volume).disk.sync(*file).map_err(refused),
        }
    }

    fn set_len(&mut self, size: u64) -> Result<(), Error> {
        match &mut self.place {
            Place::Temporary(content) => content.resize(size as usize, 0),
            Place::Disk { volume, file, .. } => lock(volume).disk.set_len(*file, size as usize).map_err(refused)?,
        }
        Ok(())
    }

    fn lock(&mut self, wanted: LockKind) -> Result<bool, Error> {
        let Place::Disk { volume, name, .. } = &self.place else { return Ok(true) };
        let mut volume = lock(volume);
        let holders = volume.locks.entry(name.clone()).or_default();
        let others = |limit| holders.iter().any(|(&holder, &held)| holder != self.id && held >= limit);
        let free = match wanted {
            LockKind::None => true,
            LockKind::Shared => !others(LockKind::Pending),
            LockKind::Reserved | LockKind::Pending => !others(LockKind::Reserved),
            LockKind::Exclusive => !others(LockKind::Shared),
        };
        if free {
            holders.insert(self.id, wanted);
        }
        Ok(free)
    }

    fn reserved(&mut self) -> Result<bool, Error> {
        let Place::Disk { volume, name, .. } = &self.place else { return Ok(false) };
        Ok(lock(volume).locks.get(name).is_some_and(|holders| holders.values().any(|&held| held >= LockKind::Reserved)))
    }

    fn current_lock(&self) -> Result<LockKind, Error> {
        let Place::Disk { volume, name, .. } = &self.place else { return Ok(LockKind::None) };
        let held = lock(volume).locks.get(name).and_then(|holders| holders.get(&self.id).copied());
        Ok(held.unwrap_or(LockKind::None))
    }

    fn wal_index(&self, _read_only: bool) -> Result<IndexHandle, Error> {
        let Place::Disk { volume, name, .. } = &self.place else { return Err(ErrorKind::Unsupported.into()) };
        let index = Arc::clone(lock(volume).indices.entry(name.clone()).or_default());
        Ok(IndexHandle { id: self.id, index })
    }
}

/// Index of a write-ahead log, common to all that have it open.
#[derive(Debug, Default)]
struct Index {
    regions: HashMap<u32, Box<[u8; REGION_BYTES]>>,
    /// True where the holder wants it for itself, by holder and place.
    locks: HashMap<(u64, u8), bool>,
}

#[derive(Debug)]
struct IndexHandle {
    id: u64,
    index: Arc<Mutex<Index>>,
}

impl WalIndex for IndexHandle {
    #[expect(clippy::large_stack_arrays, reason = "a region is small beside a thread's stack")]
    fn map(&mut self, region: u32) -> Result<[u8; REGION_BYTES], Error> {
        Ok(**lock(&self.index).regions.entry(region).or_insert_with(|| Box::new([0; REGION_BYTES])))
    }

    fn lock(&mut self, places: Range<u8>, wanted: WalIndexLock) -> Result<bool, Error> {
        let mut index = lock(&self.index);
        let alone = wanted == WalIndexLock::Exclusive;
        let taken = |&(&(holder, place), &exclusive): &(&(u64, u8), &bool)| {
            holder != self.id && places.contains(&place) && (alone || exclusive)
        };
        if wanted != WalIndexLock::None && index.locks.iter().any(|held| taken(&held)) {
            return Ok(false);
        }
        for place in places {
            match wanted {
                WalIndexLock::None => index.locks.remove(&(self.id, place)),
                WalIndexLock::Shared | WalIndexLock::Exclusive => index.locks.insert((self.id, place), alone),
            };
        }
        Ok(true)
    }

    fn delete(self) -> Result<(), Error> {
        lock(&self.index).regions.clear();
        Ok(())
    }

    fn pull(&mut self, region: u32, data: &mut [u8; REGION_BYTES]) -> Result<(), Error> {
        if let Some(current) = lock(&self.index).regions.get(&region) {
            *data = **current;
        }
        Ok(())
    }

    #[expect(clippy::large_stack_arrays, reason = "a region is small beside a thread's stack")]
    fn push(&mut self, region: u32, data: &[u8; REGION_BYTES]) -> Result<(), Error> {
        **lock(&self.index).regions.entry(region).or_insert_with(|| Box::new([0; REGION_BYTES])) = *data;
        Ok(())
    }
}
