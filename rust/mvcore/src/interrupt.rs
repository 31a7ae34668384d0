//! Ending a kernel early, and turning one that panicked into an error.
//!
//! ```text
//!   interrupt.run(kernel) ──► kernel: let interrupt = Interrupt::current();  rows.for_each(|row| { interrupt.poll(); … })
//!   interrupt.set(), from any thread ──► the next poll unwinds ──► run returns Error::Interrupted
//! ```
//!
//! Unwinding leaves any depth of calls and any parallel loop, frees what was allocated and changes no signature, so a kernel
//! needs one line a loop. It is no panic: no hook runs and nothing is printed. salsa's `Cancelled` (rust-analyzer) does the same.

use crate::error::{Error, Result};
use std::any::Any;
use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A flag that kernels poll; its clones are the same flag.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

thread_local! {
    static CURRENT: RefCell<Interrupt> = RefCell::default();
}

/// What a poll unwinds with.
struct Interrupted;

impl Interrupt {
    /// The flag under which this thread runs a kernel; one that nobody sets outside of [`Interrupt::run`]. Parallel loops take it
    /// along, as the threads of the pool have flags of their own.
    #[must_use]
    pub fn current() -> Self {
        CURRENT.with_borrow(Clone::clone)
    }

    /// Makes this the flag of all kernels that the calling thread runs from now on.
    pub fn enter(&self) {
        CURRENT.replace(self.clone());
    }

    /// Ends what runs under this flag, now and later.
    pub fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether the kernel is to end.
    #[inline]
    #[must_use]
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Leaves the kernel if the flag is set: to be called once a row or a like amount of work. An unwinding costs some 20 µs and a
    /// parallel loop may begin one for every item it has left: loops over very many items skip them by [`Interrupt::is_set`] and
    /// poll afterwards.
    #[inline]
    pub fn poll(&self) {
        if self.is_set() {
            resume_unwind(Box::new(Interrupted));
        }
    }

    /// Runs a kernel under this flag. A poll that ends it is [`Error::Interrupted`], a panic [`Error::Internal`].
    pub fn run<T>(&self, kernel: impl FnOnce() -> Result<T>) -> Result<T> {
        let outer = CURRENT.replace(self.clone());
        // What a kernel had begun to change is its own, and is dropped with it.
        let result = catch_unwind(AssertUnwindSafe(kernel));
        CURRENT.replace(outer);
        result.unwrap_or_else(|payload| Err(error_of(payload.as_ref())))
    }
}

fn error_of(payload: &(dyn Any + Send)) -> Error {
    if payload.is::<Interrupted>() {
        return Error::Interrupted;
    }
    let text = payload.downcast_ref::<&str>().copied().or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    Error::Internal { message: text.unwrap_or("a panic without a message").to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;

    #[test]
    fn a_set_flag_ends_a_parallel_loop_within_a_piece_of_work() {
        let interrupt = Interrupt::default();
        let done = AtomicBool::new(false);
        let found = interrupt.run(|| {
            let inner = Interrupt::current();
            (0..1_000_000u32).into_par_iter().for_each(|n| {
                inner.poll();
                if n == 7 {
                    interrupt.set();
                }
            });
            done.store(true, Ordering::Relaxed);
            Ok(())
        });
        assert_eq!(found, Err(Error::Interrupted));
        assert!(!done.into_inner());
    }

    #[test]
    fn flags_are_restored_and_apart() {
        let (outer, inner) = (Interrupt::default(), Interrupt::default());
        let found = outer.run(|| {
            inner.set();
            assert_eq!(
                inner.run(|| {
                    Interrupt::current().poll();
                    Ok(1)
                }),
                Err(Error::Interrupted)
            );
            Interrupt::current().poll();
            Ok(2)
        });
        assert_eq!(found, Ok(2));
        Interrupt::current().poll();
    }

    #[test]
    fn a_panic_is_an_error_with_its_message() {
        let panics = |n: usize| Interrupt::default().run(|| Ok([1, 2, 3][n]));
        assert_eq!(panics(1), Ok(2));
        let text = panics(3).unwrap_err().to_string();
        assert!(text.contains("index out of bounds"), "{text}");
        // The flag of the thread is as before.
        Interrupt::current().poll();
    }
}
