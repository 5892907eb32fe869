//! A disk in memory that logs what happens to it, and what it holds after the power is cut.
//!
//! The promise that is modelled: a successful sync of a file puts its content and size on stable storage, and the first
//! sync of a log or journal that was made anew puts the names in the directory there too, as SQLite's Unix file system
//! does. Everything since may be there or not, sector by sector and in any order, torn within a sector or replaced by
//! garbage; names come and go in the order in which they were changed. A sync that fails has written what it liked, and a
//! later one does not write it again.

use rand_core::Rng;
use std::collections::BTreeMap;

/// Bytes that a disk writes at once.
const SECTOR: usize = 512;

/// What happened, in order.
#[derive(Debug, Clone)]
enum Event {
    /// A name points to another file, or to none.
    Name { name: String, file: Option<usize> },
    /// Bytes were written.
    Write { file: usize, offset: usize, data: Vec<u8> },
    /// The file got a size.
    SetLen { file: usize, len: usize },
    /// The file is on stable storage, and with `names` the directory.
    Sync { file: usize, names: bool },
    /// A sync that failed.
    FailedSync { file: usize },
}

/// Which operation fails, and how many of its kind succeed before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Reading fails.
    Read(u32),
    /// Writing fails.
    Write(u32),
    /// Syncing fails.
    Sync(u32),
}

#[derive(Debug, Clone, Default)]
struct File {
    content: Vec<u8>,
    /// Its name is not on stable storage before its first sync.
    fresh_log: bool,
}

/// Files by name, as a process sees them.
#[derive(Debug, Clone, Default)]
pub struct Disk {
    files: Vec<File>,
    names: BTreeMap<String, usize>,
    /// What was there at the beginning, by file.
    base: Vec<Vec<u8>>,
    base_names: BTreeMap<String, usize>,
    log: Vec<Event>,
    fault: Option<Fault>,
    capacity: Option<usize>,
    lies: bool,
}

/// Why the disk refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    /// It failed.
    Broken,
    /// It is full.
    Full,
}

/// The content of every file by name.
pub type Image = BTreeMap<String, Vec<u8>>;

impl Disk {
    /// A disk that holds these files on stable storage.
    pub fn new(image: &Image) -> Self {
        let mut disk = Self::default();
        for (name, content) in image {
            disk.names.insert(name.clone(), disk.files.len());
            disk.files.push(File { content: content.clone(), fresh_log: false });
        }
        disk.base = disk.files.iter().map(|file| file.content.clone()).collect();
        disk.base_names = disk.names.clone();
        disk
    }

    /// From now on a sync that is answered has promised nothing: what such a disk loses, the tests must find.
    pub fn lie(&mut self) {
        self.lies = true;
    }

    /// Number of events so far: a moment at which the power may be cut.
    pub fn now(&self) -> usize {
        self.log.len()
    }

    /// What is on the disk as a process sees it.
    pub fn image(&self) -> Image {
        self.names.iter().map(|(name, &file)| (name.clone(), self.files[file].content.clone())).collect()
    }

    /// From now on this fails, until it is taken back; gives what failed before.
    pub fn set_fault(&mut self, fault: Option<Fault>) -> Option<Fault> {
        std::mem::replace(&mut self.fault, fault)
    }

    /// So many bytes are free from now on; none means without end.
    pub fn set_free(&mut self, free: Option<usize>) {
        self.capacity = free.map(|free| self.used() + free);
    }

    fn used(&self) -> usize {
        self.names.values().map(|&file| self.files[file].content.len()).sum()
    }

    /// The file of a name.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.names.get(name).copied()
    }

    /// Makes an empty file.
    pub fn create(&mut self, name: &str, is_log: bool) -> usize {
        let file = self.files.len();
        self.files.push(File { content: Vec::new(), fresh_log: is_log });
        self.names.insert(name.to_owned(), file);
        self.log.push(Event::Name { name: name.to_owned(), file: Some(file) });
        file
    }

    /// Takes a name away and says whether there was one.
    pub fn delete(&mut self, name: &str) -> bool {
        let found = self.names.remove(name).is_some();
        if found {
            self.log.push(Event::Name { name: name.to_owned(), file: None });
        }
        found
    }

    /// Size of a file.
    pub fn len(&self, file: usize) -> usize {
        self.files[file].content.len()
    }

    /// Reads, fills the rest with zeros and says how much was there.
    pub fn read(&mut self, file: usize, offset: usize, out: &mut [u8]) -> Result<usize, Refused> {
        if let Some(Fault::Read(left)) = &mut self.fault {
            if *left == 0 {
                return Err(Refused::Broken);
            }
            *left -= 1;
        }
        let there = self.files[file].content.get(offset..).unwrap_or_default();
        let n = there.len().min(out.len());
        out[..n].copy_from_slice(&there[..n]);
        out[n..].fill(0);
        Ok(n)
    }

    /// Writes.
    pub fn write(&mut self, file: usize, offset: usize, data: &[u8]) -> Result<(), Refused> {
        if let Some(Fault::Write(left)) = &mut self.fault {
            if *left == 0 {
                return Err(Refused::Broken);
            }
            *left -= 1;
        }
        let grown = (offset + data.len()).saturating_sub(self.len(file));
        if self.capacity.is_some_and(|capacity| self.used() + grown > capacity) {
            return Err(Refused::Full);
        }
        put(&mut self.files[file].content, offset, data);
        self.log.push(Event::Write { file, offset, data: data.to_vec() });
        Ok(())
    }

    /// Gives a file a size.
    pub fn set_len(&mut self, file: usize, len: usize) -> Result<(), Refused> {
        let grown = len.saturating_sub(self.len(file));
        if grown > 0 && self.capacity.is_some_and(|capacity| self.used() + grown > capacity) {
            return Err(Refused::Full);
        }
        self.files[file].content.resize(len, 0);
        self.log.push(Event::SetLen { file, len });
        Ok(())
    }

    /// Puts a file on stable storage.
    pub fn sync(&mut self, file: usize) -> Result<(), Refused> {
        if let Some(Fault::Sync(left)) = &mut self.fault {
            if *left == 0 {
                self.log.push(Event::FailedSync { file });
                return Err(Refused::Broken);
            }
            *left -= 1;
        }
        if self.lies {
            return Ok(());
        }
        let names = std::mem::take(&mut self.files[file].fresh_log);
        self.log.push(Event::Sync { file, names });
        Ok(())
    }

    /// What the disk may hold if the power is cut at a moment.
    pub fn cut(&self, moment: usize, rng: &mut impl Rng) -> Image {
        let mut files = self.base.iter().map(|content| After::new(content.clone())).collect::<Vec<_>>();
        files.resize_with(self.files.len(), || After::new(Vec::new()));
        let luck = Luck::draw(rng);
        let (mut names, mut pending_names) = (self.base_names.clone(), Vec::new());
        for event in &self.log[..moment] {
            match event {
                Event::Name { name, file } => pending_names.push((name, *file)),
                Event::Write { file, offset, data } => files[*file].pending.push(Pending::Write(*offset, data)),
                Event::SetLen { file, len } => files[*file].pending.push(Pending::SetLen(*len)),
                Event::Sync { file, names: with_names } => {
                    files[*file].settle(None, rng);
                    if *with_names {
                        pending_names.drain(..).for_each(|(name, file)| rename(&mut names, name, file));
                    }
                }
                Event::FailedSync { file } => files[*file].settle(Some(luck), rng),
            }
        }
        let kept = match luck {
            Luck::Nothing => 0,
            Luck::Everything => pending_names.len(),
            Luck::Some => below(rng, pending_names.len() + 1),
        };
        pending_names.into_iter().take(kept).for_each(|(name, file)| rename(&mut names, name, file));
        for file in &mut files {
            file.settle(Some(luck), rng);
        }
        names.into_iter().map(|(name, file)| (name, std::mem::take(&mut files[file].content))).collect()
    }
}

fn rename(names: &mut BTreeMap<String, usize>, name: &str, file: Option<usize>) {
    match file {
        Some(file) => names.insert(name.to_owned(), file),
        None => names.remove(name),
    };
}

fn put(content: &mut Vec<u8>, offset: usize, data: &[u8]) {
    let end = offset + data.len();
    if content.len() < end {
        content.resize(end, 0);
    }
    content[offset..end].copy_from_slice(data);
}

/// How much of what was not synced is there after the cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Luck {
    Nothing,
    Everything,
    Some,
}

impl Luck {
    fn draw(rng: &mut impl Rng) -> Self {
        match rng.next_u32() % 8 {
            0 => Self::Nothing,
            1 => Self::Everything,
            _ => Self::Some,
        }
    }
}

#[derive(Debug)]
enum Pending<'a> {
    Write(usize, &'a [u8]),
    SetLen(usize),
}

/// A file as stable storage has it, and what was done to it since.
#[derive(Debug)]
struct After<'a> {
    content: Vec<u8>,
    pending: Vec<Pending<'a>>,
}

impl After<'_> {
    fn new(content: Vec<u8>) -> Self {
        Self { content, pending: Vec::new() }
    }

    /// Puts what is pending on stable storage: all of it, or as luck has it.
    fn settle(&mut self, luck: Option<Luck>, rng: &mut impl Rng) {
        for pending in self.pending.drain(..) {
            match (luck, pending) {
                (Some(Luck::Nothing), _) => {}
                (None | Some(Luck::Everything), Pending::Write(offset, data)) => put(&mut self.content, offset, data),
                (None | Some(Luck::Everything), Pending::SetLen(len)) => self.content.resize(len, 0),
                (Some(Luck::Some), Pending::SetLen(len)) => {
                    if rng.next_u32().is_multiple_of(2) {
                        self.content.resize(len, 0);
                    }
                }
                (Some(Luck::Some), Pending::Write(offset, data)) => tear(&mut self.content, offset, data, rng),
            }
        }
    }
}

/// Writes some sectors, leaves others, tears others or fills them with garbage. Sectors lie where the disk has them; bytes
/// beside those that are written keep their values.
fn tear(content: &mut Vec<u8>, offset: usize, data: &[u8], rng: &mut impl Rng) {
    let mut at = 0;
    while at < data.len() {
        let end = (((offset + at) / SECTOR + 1) * SECTOR - offset).min(data.len());
        let sector = &data[at..end];
        match rng.next_u32() % 16 {
            0..8 => put(content, offset + at, sector),
            8..13 => {}
            13 => put(content, offset + at, &sector[..below(rng, sector.len() + 1)]),
            14 => put(content, offset + at, &vec![0; sector.len()]),
            _ => {
                let mut garbage = vec![0; sector.len()];
                rng.fill_bytes(&mut garbage);
                put(content, offset + at, &garbage);
            }
        }
        at = end;
    }
}

/// A number below a limit, which is not 0.
pub fn below(rng: &mut impl Rng, limit: usize) -> usize {
    (rng.next_u64() % limit as u64) as usize
}
