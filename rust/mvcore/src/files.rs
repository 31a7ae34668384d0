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

/// Vertices and triangles of all objects of an OBJ file; polygons are cut into triangles.
pub fn read_obj(path: &str) -> Result<(Vec<[f64; 3]>, Vec<[u32; 3]>)> {
    let options = tobj::LoadOptions { triangulate: true, ..Default::default() };
    let failed = |e: tobj::LoadError| Error::File { path: path.into(), reason: e.to_string() };
    let (models, _) = tobj::load_obj(path, &options).map_err(failed)?;
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for model in models {
        let base = vertices.len() as u32;
        vertices.extend(model.mesh.positions.as_chunks::<3>().0.iter().map(|p| p.map(f64::from)));
        faces.extend(model.mesh.indices.as_chunks::<3>().0.iter().map(|f| f.map(|v| v + base)));
    }
    Ok((vertices, faces))
}

#[cfg(test)]
mod tests {
    use super::*;

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
    }
}
