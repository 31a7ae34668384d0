//! Large buffers on huge pages: the first touch of fresh memory is a page fault each 4 KiB, more than most kernels do there.

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
    fn large_and_small_buffers_are_zero() {
        for len in [0, 3, LEAST / 4 + 1] {
            let mut values = zeroed::<u32>(len);
            assert!(values.len() == len && values.iter().all(|&v| v == 0));
            values.iter_mut().for_each(|v| *v = 7);
        }
    }
}
