//! The one way out of Python: a kernel runs without the interpreter lock, ends when it is asked to, and its panics are errors.

use crate::convert::to_python;
use mvcore::interrupt::Interrupt as Flag;
use mvcore::{Error, Result};
use pyo3::prelude::*;
use pyo3::types::PyAnyMethods;
use std::cell::OnceCell;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// Between two looks for signals.
const WAKE: Duration = Duration::from_millis(50);
/// Of the thread that runs a kernel: what main threads have.
const STACK: usize = 8 << 20;

/// Ends the kernels of the threads that entered it.
#[pyclass(module = "mvcore._core", frozen)]
#[derive(Default)]
pub struct Interrupt(Flag);

#[pymethods]
impl Interrupt {
    #[new]
    fn new() -> Self {
        Self::default()
    }

    /// Kernels that the calling thread runs from now on end when this is set; the main thread's end at signals alone.
    fn enter(&self) {
        self.0.enter();
    }

    /// Ends the kernels, now and later.
    fn set(&self) {
        self.0.set();
    }
}

/// Runs a kernel without the interpreter lock and maps its error. Python's main thread, which alone handles signals, waits for it
/// and looks for them: an exception that a handler raises (Ctrl-C) ends the kernel at its next poll.
pub fn run<T: Send>(py: Python<'_>, kernel: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    if !on_main_thread(py)? {
        return run_briefly(py, kernel);
    }
    let flag = Flag::default();
    let (result, raised) = py.detach(|| watched(&flag, kernel));
    match raised {
        Some(error) => Err(error),
        None => result.map_err(|error| to_python(py, &error)),
    }
}

/// The same for kernels of milliseconds: signals wait until it is done.
pub fn run_briefly<T: Send>(py: Python<'_>, kernel: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    py.detach(|| Flag::current().run(kernel)).map_err(|error| to_python(py, &error))
}

/// The result of a kernel on a thread of its own, and what a signal handler raised meanwhile.
fn watched<T: Send>(flag: &Flag, kernel: impl FnOnce() -> Result<T> + Send) -> (Result<T>, Option<PyErr>) {
    let (send, receive) = channel();
    let work = move || {
        let _ = send.send(flag.run(kernel));
    };
    let gone = || Err(Error::Internal { message: "a kernel's thread could not be run".to_owned() });
    thread::scope(|scope| {
        if thread::Builder::new().name("mvcore-kernel".to_owned()).stack_size(STACK).spawn_scoped(scope, work).is_err()
        {
            return (gone(), None);
        }
        loop {
            match receive.recv_timeout(WAKE) {
                Ok(result) => return (result, None),
                Err(RecvTimeoutError::Disconnected) => return (gone(), None),
                Err(RecvTimeoutError::Timeout) => {}
            }
            if let Err(error) = Python::attach(|py| py.check_signals()) {
                flag.set();
                return (receive.recv().unwrap_or_else(|_| gone()), Some(error));
            }
        }
    })
}

fn on_main_thread(py: Python<'_>) -> PyResult<bool> {
    thread_local! {
        static MAIN: OnceCell<bool> = const { OnceCell::new() };
    }
    if let Some(main) = MAIN.with(|m| m.get().copied()) {
        return Ok(main);
    }
    let threading = py.import("threading")?;
    let main = threading.call_method0("current_thread")?.is(&threading.call_method0("main_thread")?);
    Ok(MAIN.with(|m| *m.get_or_init(|| main)))
}

/// Messages and places of the latest panics.
static PANICS: Mutex<Vec<(String, String)>> = Mutex::new(Vec::new());
const KEPT_PANICS: usize = 8;

/// Keeps where a panic was for its error, instead of printing it: a library does not print.
pub fn keep_panics() {
    std::panic::set_hook(Box::new(|info| {
        let place = info.location().map_or_else(String::new, ToString::to_string);
        let mut kept = PANICS.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() == KEPT_PANICS {
            kept.remove(0);
        }
        kept.push((info.payload_as_str().unwrap_or_default().to_owned(), place));
    }));
}

/// Where the latest panic with this message was.
pub fn place_of_panic(message: &str) -> Option<String> {
    let kept = PANICS.lock().unwrap_or_else(PoisonError::into_inner);
    kept.iter().rev().find(|(text, _)| text == message).map(|(_, place)| place.clone())
}
