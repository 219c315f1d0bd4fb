//! A connection that waits for a reader, but not for ever.
use std::io::{self, ErrorKind};
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Sleep, sleep};

/// A stream whose writes fail once the other side took nothing for a while.
pub(crate) struct Patient<S> {
    stream: S,
    patience: Duration,
    /// Runs while a write waits.
    end: Option<Pin<Box<Sleep>>>,
}

impl<S> Patient<S> {
    pub(crate) fn new(stream: S, patience: Duration) -> Self {
        Self {
            stream,
            patience,
            end: None,
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Patient<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Patient<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        if written.is_ready() {
            self.end = None;
            return written;
        }
        let patience = self.patience;
        let end = self.end.get_or_insert_with(|| Box::pin(sleep(patience)));
        let ended = end.as_mut().poll(context);
        ended.map(|()| Err(ErrorKind::TimedOut.into()))
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;

    use tokio::runtime;
    use tokio::time::timeout;

    use super::*;

    /// Takes every second, third and so on of what it is asked to, or nothing if `every` is 0.
    struct Taking {
        every: usize,
        asked: usize,
    }

    impl AsyncWrite for Taking {
        fn poll_write(
            mut self: Pin<&mut Self>,
            context: &mut Context<'_>,
            bytes: &[u8],
        ) -> Poll<io::Result<usize>> {
            self.asked += 1;
            if self.every > 0 && self.asked.is_multiple_of(self.every) {
                return Poll::Ready(Ok(bytes.len()));
            }
            if self.every > 0 {
                context.waker().wake_by_ref();
            }
            Poll::Pending
        }

        fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
            Poll::Ready(Ok(()))
        }

        fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
            Poll::Ready(Ok(()))
        }
    }

    fn written(every: usize, patience: Duration) -> io::Result<usize> {
        let runtime = runtime::Builder::new_current_thread().enable_time().build();
        let taking = Taking { every, asked: 0 };
        let mut stream = Patient::new(taking, patience);
        let write = async {
            let mut all = 0;
            for _ in 0..3 {
                all += poll_fn(|c| Pin::new(&mut stream).poll_write(c, b"x")).await?;
            }
            Ok(all)
        };
        // More than any write takes on a slow machine.
        let most = Duration::from_secs(60);
        let done = runtime
            .unwrap()
            .block_on(async { timeout(most, write).await });
        done.expect("the write ends")
    }

    #[test]
    fn a_reader_who_takes_nothing_is_given_up() {
        let error = written(0, Duration::from_millis(1)).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::TimedOut);
    }

    #[test]
    fn a_reader_who_takes_something_now_and_then_is_waited_for() {
        assert_eq!(written(2, Duration::from_secs(60)).unwrap(), 3);
    }
}
