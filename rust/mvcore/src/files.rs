//! The atlas as PNG bytes, and OBJ meshes from disk.

use crate::error::{Error, Result, require};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

/// A (height, width, 3) RGB picture as the bytes of a PNG file.
pub fn encode_png(rgb: &[u8], width: usize, height: usize) -> Result<Vec<u8>> {
    require(rgb.len() == width * height * 3, "rgb", format!("{} bytes", width * height * 3), rgb.len())?;
    let mut out = Vec::new();
    PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Adaptive)
        .write_image(rgb, width as u32, height as u32, ExtendedColorType::Rgb8)
        .map_err(|e| Error::File { path: "png".into(), reason: e.to_string() })?;
    Ok(out)
}

/// Positions and triangles of an OBJ file in double precision; polygons are cut into fans, normals, textures and groups passed over.
///
/// A vertex line is `v x y z`, with a weight that divides or a colour behind it; a corner of a face counts vertices from 1, or back from
/// the latest where it is negative.
pub fn read_obj(path: &str) -> Result<(Vec<[f64; 3]>, Vec<[u32; 3]>)> {
    let failed = |reason: String| Error::File { path: path.into(), reason };
    if std::fs::metadata(path).is_ok_and(|m| !m.is_file()) {
        return Err(failed("expected a regular file".into()));
    }
    let bytes = std::fs::read(path).map_err(|error| failed(error.to_string()))?;
    parse_obj(&String::from_utf8_lossy(&bytes))
        .map_err(|(line, reason)| Error::File { path: format!("{path}:{line}"), reason })
}

/// The same from a text; an error has its line.
fn parse_obj(text: &str) -> std::result::Result<(Vec<[f64; 3]>, Vec<[u32; 3]>), (usize, String)> {
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    let mut corners = Vec::new();
    let mut continued = false;
    for (n, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or_default().trim_end();
        let (line, more) = line.strip_suffix('\\').map_or((line, false), |start| (start, true));
        let mut words = line.split_whitespace();
        let kind = if continued { Some("f") } else { words.next() };
        match kind {
            Some("v") => vertices.push(vertex(words).map_err(|reason| (n + 1, reason))?),
            Some("f") => {
                for word in words {
                    corners.push(corner(word, vertices.len()).map_err(|reason| (n + 1, reason))?);
                }
            }
            _ => {}
        }
        continued = more && kind == Some("f");
        if !continued {
            faces.extend(corners.windows(2).skip(1).map(|pair| [corners[0], pair[0], pair[1]]));
            corners.clear();
        }
    }
    Ok((vertices, faces))
}

fn vertex<'a>(words: impl Iterator<Item = &'a str>) -> std::result::Result<[f64; 3], String> {
    let mut values = [0.0, 0.0, 0.0, 1.0];
    let mut count = 0;
    for word in words {
        let value: f64 = word.parse().map_err(|_| format!("expected a number, got {word:.40}"))?;
        if count < 4 {
            values[count] = value;
        }
        count += 1;
    }
    // Four numbers are a point and its weight; more are a point and a colour.
    let [x, y, z, w] = values;
    let weight = if count == 4 { w } else { 1.0 };
    let point = [x / weight, y / weight, z / weight];
    if count < 3 || !point.iter().all(|v| v.is_finite()) {
        return Err("expected 'v x y z' of finite numbers".into());
    }
    Ok(point)
}

fn corner(word: &str, count: usize) -> std::result::Result<u32, String> {
    let number: i64 =
        word.split('/').next().unwrap_or_default().parse().map_err(|_| format!("expected a vertex, got {word:.40}"))?;
    let from_zero = if number < 0 { count as i64 + number } else { number - 1 };
    u32::try_from(from_zero)
        .ok()
        .filter(|&v| (v as usize) < count)
        .ok_or_else(|| format!("vertex {number} of {count} before this line"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_picture_survives_png() {
        let rgb: Vec<u8> = (0..7 * 5 * 3).map(|i| (i * 37) as u8).collect();
        let png = encode_png(&rgb, 7, 5).unwrap();
        assert_eq!(image::load_from_memory(&png).unwrap().to_rgb8().into_raw(), rgb);
        assert!(encode_png(&rgb, 7, 6).is_err());
    }

    #[test]
    fn a_quad_becomes_two_triangles_and_a_missing_file_is_named() {
        let path = std::env::temp_dir().join(format!("mvcore-{}.obj", std::process::id()));
        std::fs::write(&path, "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n").unwrap();
        let (vertices, faces) = read_obj(path.to_str().unwrap()).unwrap();
        std::fs::remove_file(&path).unwrap();
        assert_eq!((vertices.len(), faces.len()), (4, 2));
        assert!(read_obj("missing.obj").unwrap_err().to_string().contains("missing.obj"));
        assert!(read_obj(std::env::temp_dir().to_str().unwrap()).unwrap_err().to_string().contains("regular file"));
    }

    #[test]
    fn obj_dialects() {
        let text = "# a\nv 500000.125 0 0 0.1 0.2 0.3\nv 2 0 0 2 # half\nv 1 1 0\nvn 0 0 1\no x\nf 1/1/1 2//1 \\\n -1\nf 1 2\nl 1 2\n";
        let (vertices, faces) = parse_obj(text).unwrap();
        assert_eq!(vertices, [[500000.125, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]);
        assert_eq!(faces, [[0, 1, 2]]);
        for (bad, line) in [
            ("v 1 2", 1),
            ("v 1 2 x", 1),
            ("\nv 1 2 nan", 2),
            ("v 1 2 3 0", 1),
            ("f 1 2 3", 1),
            ("v 0 0 0\nf 1 1 2", 2),
            ("v 0 0 0\nf 1 1 -2", 2),
            ("v 0 0 0\nf 0 1 1", 2),
            ("v 0 0 0\nf 1 1 99999999999999999999", 2),
        ] {
            assert_eq!(parse_obj(bad).unwrap_err().0, line, "{bad}");
        }
    }

    proptest! {
        #[test]
        fn what_is_written_reads_the_same(
            points in prop::collection::vec(prop::array::uniform3(-1e9f64..1e9), 1..20),
            picks in prop::collection::vec(prop::array::uniform3(any::<prop::sample::Index>()), 0..20),
        ) {
            let faces: Vec<[u32; 3]> = picks.iter().map(|f| f.map(|i| i.index(points.len()) as u32)).collect();
            let mut text = String::new();
            for [x, y, z] in &points {
                text += &format!("v {x} {y} {z}\n");
            }
            for [a, b, c] in &faces {
                text += &format!("f {} {}/{} -{}\n", a + 1, b + 1, 7, points.len() as u32 - c);
            }
            prop_assert_eq!(parse_obj(&text).unwrap(), (points, faces));
        }

        #[test]
        fn any_text_is_read_or_refused(text in "[vf#/0-9. e\\\\\n-]{0,80}|\\PC{0,40}") {
            if let Ok((vertices, faces)) = parse_obj(&text) {
                prop_assert!(vertices.iter().flatten().all(|v| v.is_finite()));
                prop_assert!(faces.iter().flatten().all(|&v| (v as usize) < vertices.len()));
            }
        }
    }
}
