//! Why a store cannot be used, and why a commit failed.

use crate::SCHEMA;
use merganser_protocol::ids::EntryId;
use redb::{CommitError as RedbCommit, DatabaseError, StorageError, TableError, TransactionError};
use std::io;
use std::path::PathBuf;
use thiserror::Error;

/// Why a store cannot be used.
#[derive(Debug, Error)]
pub enum StoreError {
    /// Another process has it.
    #[error("store {path}: another agent uses it; stop that one, or give this one a store of its own", path = .0.display())]
    InUse(PathBuf),
    /// It belongs to somebody else.
    #[error(
        "store {path} belongs to {owner}, not to {wanted}; give each robot a store of its own",
        path = path.display()
    )]
    Foreign {
        /// Where.
        path: PathBuf,
        /// `swarm/robot` it was made for.
        owner: String,
        /// `swarm/robot` that opens it.
        wanted: String,
    },
    /// It was written by a later version of this program.
    #[error(
        "store {path} has schema {found}, this program reads {SCHEMA} and older; use the program that wrote it, or move \
         the file away: an empty store begins a new epoch and fetches the swarm's facts again",
        path = path.display()
    )]
    Schema {
        /// Where.
        path: PathBuf,
        /// The version found.
        found: String,
    },
    /// It was a store, and is so damaged that it cannot be opened.
    #[error(
        "store {path} is damaged beyond mending ({reason}); [store] on_damage = \"renew\" moves it aside and begins an empty \
         one, or move the file away: an empty store begins a new epoch and fetches the swarm's facts again",
        path = path.display()
    )]
    Damaged {
        /// Where.
        path: PathBuf,
        /// What the database said.
        reason: String,
    },
    /// It is no database, and nothing tells that it ever was a store of facts.
    #[error(
        "store {path} is no store of facts ({reason}); check store.path, or move the file away: an empty store begins a \
         new epoch and fetches the swarm's facts again",
        path = path.display()
    )]
    NotAStore {
        /// Where.
        path: PathBuf,
        /// What the database said.
        reason: String,
    },
    /// The disk failed.
    #[error(
        "store {path}: the disk fails ({reason}), and nothing was changed; mend or replace it, or move the file to one that \
         works; without the file, an empty store begins a new epoch and fetches the swarm's facts again",
        path = path.display()
    )]
    Failed {
        /// Where.
        path: PathBuf,
        /// What it said.
        reason: String,
    },
}

/// Why a commit failed. Nothing of it is stored.
#[derive(Debug, Error)]
pub enum CommitError {
    /// No room.
    #[error("the disk is full: {0}")]
    Full(String),
    /// Anything else that the disk or the database said.
    #[error("{0}")]
    Failed(String),
    /// Somebody writes one log twice; our bug.
    #[error("entry {0} is already stored with other bytes")]
    Conflict(EntryId),
}

impl CommitError {
    pub(crate) fn of_io(error: &io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge => {
                Self::Full(error.to_string())
            }
            _ => Self::Failed(error.to_string()),
        }
    }
}

impl From<redb::Error> for CommitError {
    fn from(error: redb::Error) -> Self {
        match &error {
            redb::Error::Io(io) => Self::of_io(io),
            other => Self::Failed(other.to_string()),
        }
    }
}

macro_rules! through_redb {
    ($($error:ty),*) => {$(
        impl From<$error> for CommitError {
            fn from(error: $error) -> Self {
                redb::Error::from(error).into()
            }
        }
    )*};
}
through_redb!(DatabaseError, StorageError, TableError, TransactionError, RedbCommit);
