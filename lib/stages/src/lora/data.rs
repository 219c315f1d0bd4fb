//! What the adapter is trained on.
use candle_core::Tensor;
use dipir_diffusion::crop::{CropBox, resample};
use dipir_diffusion::distillation::InpaintCondition;
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::training::{Example, TrainingData};

/// Crops of the photograph and images of the class.
pub(super) struct Data<'a> {
    pub(super) model: &'a Model,
    pub(super) photo: Tensor,
    pub(super) size: usize,
    pub(super) min_crop: f64,
    pub(super) prompt: String,
    pub(super) class_prompt: String,
    pub(super) concepts: Option<Tensor>,
}

impl Data<'_> {
    fn place(&self, tensor: &Tensor) -> dipir_diffusion::Result<Tensor> {
        Ok(tensor
            .to_device(self.model.device())?
            .to_dtype(self.model.dtype())?)
    }

    /// A rectangle to paint, of 0.3 to 0.9 of each side, for inpainting models.
    fn mask(
        &self,
        image: &Tensor,
        stream: &mut NoiseStream,
    ) -> dipir_diffusion::Result<Option<InpaintCondition>> {
        if !self.model.is_inpainting() {
            return Ok(None);
        }
        let (_, _, height, width) = image.dims4()?;
        let mut span = |n: usize| {
            let length = ((0.3 + 0.6 * stream.uniform()) * n as f64) as usize;
            let first = stream.below(n - length + 1);
            first..first + length
        };
        let (rows, columns) = (span(height), span(width));
        let values: Vec<f32> = (0..height * width)
            .map(|i| {
                if rows.contains(&(i / width)) && columns.contains(&(i % width)) {
                    1.0
                } else {
                    0.0
                }
            })
            .collect();
        let mask = self.place(&Tensor::from_vec(
            values,
            (1, 1, height, width),
            image.device(),
        )?)?;
        Ok(Some(InpaintCondition::new(&self.model.vae, image, &mask)?))
    }
}

impl TrainingData for Data<'_> {
    fn instance(&self, stream: &mut NoiseStream) -> dipir_diffusion::Result<Example> {
        let (_, height, width) = self.photo.dims3()?;
        let region = CropBox::random(width, height, self.min_crop, stream);
        let image = self.place(&resample(&self.photo, region, self.size)?)?;
        let inpaint = self.mask(&image, stream)?;
        Ok(Example {
            latents: self.model.vae.encode(&image)?.detach(),
            prompt: self.prompt.clone(),
            inpaint,
        })
    }

    fn prior(&self, stream: &mut NoiseStream) -> dipir_diffusion::Result<Option<Example>> {
        let Some(concepts) = &self.concepts else {
            return Ok(None);
        };
        let index = stream.below(concepts.dim(0)?);
        let latents = self.place(&concepts.narrow(0, index, 1)?)?;
        let inpaint = match self.model.is_inpainting() {
            true => self.mask(&self.model.vae.decode(&latents)?.detach(), stream)?,
            false => None,
        };
        Ok(Some(Example {
            latents,
            prompt: self.class_prompt.clone(),
            inpaint,
        }))
    }
}
