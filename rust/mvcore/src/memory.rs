//! Large buffers on huge pages: the first touch of fresh memory is a page fault each 4 KiB, more than most kernels do there.

use crate::error::{Error, Result};

/// Bytes from which an allocation is compared with the memory that is free.
const LARGE: usize = 1 << 28;

/// Whether as many bytes as the product of `factors` can be allocated for `what`; they are not kept.
///
/// Allocations that fail end the process. A size that a caller chooses is tried first, and where it is large also compared with the
/// memory that the system says is available: it may promise more than it has.
pub fn room(what: &'static str, factors: &[usize]) -> Result<()> {
    let needed = factors.iter().try_fold(1usize, |product, &factor| product.checked_mul(factor));
    let bytes = needed.unwrap_or(usize::MAX);
    if bytes >= LARGE
        && let Some(allowed) = available().filter(|&allowed| bytes > allowed)
    {
        return Err(Error::OutOfMemory { what, needed: bytes, allowed });
    }
    let allowed = isize::MAX as usize;
    Vec::<u8>::new().try_reserve_exact(bytes).map_err(|_| Error::OutOfMemory { what, needed: bytes, allowed })
}

/// Bytes of memory and swap that are free or can be freed.
#[cfg(target_os = "linux")]
fn available() -> Option<usize> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let of = |name: &str| -> Option<usize> {
        let rest = text.lines().find_map(|line| line.strip_prefix(name))?;
        rest.split_whitespace().next()?.parse::<usize>().ok()?.checked_mul(1024)
    };
    of("MemAvailable:")?.checked_add(of("SwapFree:").unwrap_or(0))
}

#[cfg(not(target_os = "linux"))]
fn available() -> Option<usize> {
    None
}

/// Bytes below which huge pages do not pay.
const LEAST: usize = 4 << 20;

/// `len` default values (zeros); when large, the system is asked to back them with huge pages. Nothing is touched yet.
pub fn zeroed<T: Copy + Default>(len: usize) -> Vec<T> {
    let values = vec![T::default(); len];
    advise(&values);
    values
}

#[cfg(target_os = "linux")]
fn advise<T>(values: &[T]) {
    const PAGE: usize = 4096;
    let bytes = size_of_val(values);
    if bytes < LEAST {
        return;
    }
    let start = (values.as_ptr() as usize).next_multiple_of(PAGE);
    let end = (values.as_ptr() as usize + bytes) / PAGE * PAGE;
    if start < end {
        // SAFETY: the whole pages [start, end) lie inside a live allocation; this advice changes no contents, and a system
        // that refuses it is as good as before.
        unsafe {
            libc::madvise(start as *mut libc::c_void, end - start, libc::MADV_HUGEPAGE);
        }
    }
}

#[cfg(not(target_os = "linux"))]
fn advise<T>(_values: &[T]) {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_than_there_is_has_no_room() {
        assert!(
            room("image", &[640, 480, 3]).is_ok()
                && room("image", &[]).is_ok()
                && room("image", &[0, usize::MAX]).is_ok()
        );
        for factors in [&[usize::MAX, 2][..], &[1 << 40, 1 << 6], &[usize::MAX]] {
            let error = room("image", factors).unwrap_err();
            assert!(error.to_string().starts_with("image needs"), "{error}");
        }
    }

    #[test]
    fn large_and_small_buffers_are_zero() {
        for len in [0, 3, LEAST / 4 + 1] {
            let mut values = zeroed::<u32>(len);
            assert!(values.len() == len && values.iter().all(|&v| v == 0));
            values.iter_mut().for_each(|v| *v = 7);
        }
    }
}
