//! The one thread that draws what viewers see.
//!
//! Invariants: whatever is watched, drawing takes one core at most, and where the system lets a thread stand back (Linux), only
//! what stepping leaves of it; a drawing that fails is an error of its viewers and nobody else's. Orders wait in a queue that
//! needs no bound: who orders waits for the picture before the next one.

use super::super::{from_proto::RenderMode, status::CallError};
use crate::{
    batch::Picture,
    raster::{Format, rasterise_within},
};
use bytes::Bytes;
use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::mpsc,
    thread,
};
use tokio::sync::oneshot;

/// How the picture is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Style {
    pub mode: RenderMode,
    /// Pixels across at most.
    pub max_width: u32,
}

/// What was drawn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Drawn {
    pub content: Bytes,
    /// 0 for text.
    pub width: u32,
    pub height: u32,
}

struct Order {
    picture: Box<dyn Picture>,
    style: Style,
    reply: oneshot::Sender<Result<Drawn, CallError>>,
}

/// Where orders go. The thread ends when this is dropped.
#[derive(Debug)]
pub struct Painter(mpsc::Sender<Order>);

impl Painter {
    pub fn start() -> Result<Self, CallError> {
        let (orders, waiting) = mpsc::channel::<Order>();
        let work = move || {
            stand_back();
            for Order { picture, style, reply } in waiting {
                // A viewer that has gone wants no picture.
                if !reply.is_closed() {
                    let drawn = catch_unwind(AssertUnwindSafe(|| draw(&*picture, style)));
                    let _ = reply.send(drawn.unwrap_or_else(|_| Err(failed())));
                }
            }
        };
        let thread = thread::Builder::new().name("mazeway-painter".into()).spawn(work);
        thread.map_err(|error| CallError::Internal(format!("no thread to draw on: {error}")))?;
        Ok(Self(orders))
    }

    /// Draws.
    pub async fn draw(&self, picture: Box<dyn Picture>, style: Style) -> Result<Drawn, CallError> {
        let (reply, drawn) = oneshot::channel();
        self.0.send(Order { picture, style, reply }).map_err(|_| failed())?;
        drawn.await.map_err(|_| failed())?
    }
}

fn failed() -> CallError {
    CallError::Internal("a picture could not be drawn".into())
}

fn draw(picture: &dyn Picture, style: Style) -> Result<Drawn, CallError> {
    let format = match style.mode {
        RenderMode::Ansi => return Ok(Drawn { content: picture.text().into(), width: 0, height: 0 }),
        RenderMode::RgbArray => Format::Rgb,
        RenderMode::Png => Format::Png,
    };
    let drawn = rasterise_within(&picture.svg(), format, style.max_width)
        .map_err(|error| CallError::Internal(error.to_string()))?;
    Ok(Drawn { content: drawn.content.into(), width: drawn.width, height: drawn.height })
}

/// Leaves the processor to whoever else wants it.
fn stand_back() {
    #[cfg(target_os = "linux")]
    {
        // Of a thread, here. Without it pictures are drawn all the same.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 10);
    }
}
