//! `Watch`: a session seen by others while somebody steps it.
//!
//! A step sets nothing in motion: a group of viewers ([`gallery`]) asks for a look when it wants one, the session's owner
//! grants it with a copy of the environment's state (`sessions/sight.rs`), and a thread of its own draws ([`painter`]).
//! Invariants: nothing that a viewer does or leaves undone holds up a step; a viewer reads the latest picture or none.

mod gallery;
mod painter;

pub use gallery::Gallery;

use super::{
    from_proto::{self, RenderMode},
    host::Host,
    status::CallError,
};
use futures_util::{Stream, stream};
use gallery::{Frame, Place, Shown, Subject};
use mazeway_proto::env as pb;
use mazeway_serving::Caller;
use painter::Style;
use std::{
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::time::sleep_until;
use tonic::Status;

/// Pictures a second that nobody needs more than.
const MAX_FPS: f32 = 60.0;
/// Fewest pictures a second.
const MIN_FPS: f32 = 0.01;

/// Lets a viewer in.
pub fn watch(
    host: &Arc<Host>,
    caller: &Caller,
    request: &pb::WatchRequest,
) -> Result<impl Stream<Item = Result<pb::WatchResponse, Status>> + Send + use<>, CallError> {
    let session = from_proto::session_id(&request.session_id)?;
    let mode = from_proto::render_mode(request.mode)?;
    let max_width = match (request.max_width, mode) {
        (0, _) => u32::MAX,
        (_, RenderMode::Ansi) => {
            return Err(CallError::malformed("max_width", "expected none with text, which has no pixels"));
        }
        (width, _) => width,
    };
    let asked = request.max_fps;
    // Also whether it may look at all: viewers of one session share what they see.
    let own = host.sessions.render_fps(session, caller.name(), Instant::now())? as f32;
    let fps = if asked == 0.0 { own } else { asked };
    if !(MIN_FPS..=f32::MAX).contains(&fps) {
        let message =
            format!("expected at least {MIN_FPS} pictures a second, or 0 for the environment's own, got {asked}");
        return Err(CallError::malformed("max_fps", message));
    }
    let pause = Duration::from_secs_f32(1.0 / fps.min(MAX_FPS));
    let subject = Subject { session, index: request.index as usize, style: Style { mode, max_width } };
    let place = Gallery::enter(host, subject, pause)?;
    let viewer = Viewer { place, pause, due: Instant::now(), seen: None };
    Ok(stream::unfold(Some(viewer), async |viewer| {
        let mut viewer = viewer?;
        match viewer.next().await {
            Ok(Some(answer)) => Some((Ok(answer), Some(viewer))),
            Ok(None) => None,
            Err(error) => Some((Err(error.into()), None)),
        }
    }))
}

/// One who watches.
struct Viewer {
    place: Place,
    pause: Duration,
    /// When the next picture may be shown.
    due: Instant,
    /// Changes of the session at the last one.
    seen: Option<u64>,
}

impl Viewer {
    /// The next picture: the latest there is, once it is another than the last.
    async fn next(&mut self) -> Result<Option<pb::WatchResponse>, CallError> {
        loop {
            let shown = self.place.latest.borrow_and_update().clone();
            match shown {
                Shown::Over(outcome) => return outcome.map(|()| None),
                Shown::Frame(frame) if self.seen != Some(frame.moment.changes) => {
                    if self.due <= Instant::now() {
                        return Ok(Some(self.take(&frame)));
                    }
                    // Until then there may be a later one.
                    sleep_until(self.due.into()).await;
                }
                Shown::Frame(_) | Shown::Nothing => {
                    // Without a group there is no server.
                    self.place.latest.changed().await.map_err(|_| CallError::ShuttingDown)?;
                }
            }
        }
    }

    fn take(&mut self, frame: &Frame) -> pb::WatchResponse {
        let Frame { moment, drawn } = frame;
        let skipped = self.seen.map_or(0, |seen| moment.changes.saturating_sub(seen + 1));
        (self.seen, self.due) = (Some(moment.changes), Instant::now() + self.pause);
        pb::WatchResponse {
            content: drawn.content.clone(),
            width: drawn.width,
            height: drawn.height,
            step: moment.steps,
            episode_step: moment.episode_steps,
            episode_ended: moment.ended,
            skipped,
        }
    }
}
