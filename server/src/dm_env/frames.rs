//! The gRPC service: frames in, frames out. Messages are decoded and encoded by the connection, so that a malformed one is
//! answered within the stream and a step's answer is written without a message in between.

use super::process::process;
use crate::grpc::host::Host;
use bytes::Bytes;
use futures_util::StreamExt as _;
use mazeway_proto::raw::Raw;
use mazeway_serving::Caller;
use std::{
    convert::Infallible,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
};
use tonic::{
    Request, Response, Status, Streaming,
    body::Body as Reply,
    codegen::{Body, BoxFuture, Service, StdError, http, tokio_stream::Stream},
    server::{Grpc, NamedService, StreamingService},
};

/// Largest request by default: settings and the actions of a large batch. It is small, as a decoded request may take some
/// thirty times as much.
const MAX_REQUEST_BYTES: usize = 1 << 20;
/// Bytes of an action in a request, at most.
const BYTES_AN_ACTION: usize = 10;

/// `dm_env_rpc.v1.Environment` over one [`Host`].
#[derive(Clone)]
pub struct EnvironmentServer(pub Arc<Host>);

impl NamedService for EnvironmentServer {
    const NAME: &'static str = "dm_env_rpc.v1.Environment";
}

impl<B> Service<http::Request<B>> for EnvironmentServer
where
    B: Body + Send + 'static,
    B::Error: Into<StdError> + Send + 'static,
{
    type Response = http::Response<Reply>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Self::Error>;

    fn poll_ready(&mut self, _cx: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<B>) -> Self::Future {
        if request.uri().path() != "/dm_env_rpc.v1.Environment/Process" {
            let status = Status::unimplemented("expected the method Process of dm_env_rpc.v1.Environment");
            return Box::pin(std::future::ready(Ok(status.into_http())));
        }
        let method = Process(Arc::clone(&self.0));
        let config = &self.0.config;
        let actions = config.max_envs_per_session.saturating_mul(BYTES_AN_ACTION).saturating_add(4096);
        let largest_request = MAX_REQUEST_BYTES.max(actions).min(config.max_message_bytes);
        let mut grpc = Grpc::new(Raw)
            .max_decoding_message_size(largest_request)
            // Observations are within the limit; their frame comes on top.
            .max_encoding_message_size(config.max_message_bytes.saturating_add(4096));
        Box::pin(async move { Ok(grpc.streaming(method, request).await) })
    }
}

struct Process(Arc<Host>);

impl StreamingService<Bytes> for Process {
    type Response = Bytes;
    type ResponseStream = Pin<Box<dyn Stream<Item = Result<Bytes, Status>> + Send>>;
    type Future = BoxFuture<Response<Self::ResponseStream>, Status>;

    fn call(&mut self, request: Request<Streaming<Bytes>>) -> Self::Future {
        let caller = Caller::of(&request);
        let answers = process(Arc::clone(&self.0), caller, request.into_inner()).boxed();
        Box::pin(std::future::ready(Ok(Response::new(answers))))
    }
}
