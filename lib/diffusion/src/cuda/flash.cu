// Attention of heads of 64 values on tensor cores, without ever storing the scores: each block takes 128 queries of a head
// over all keys, 64 at a time, and keeps the largest score and the sum so far [Dao 2023]. For compute capability 8.0 on.
#include <cuda_bf16.h>
#include <cuda_fp16.h>

typedef long long i64;
typedef unsigned int u32;

constexpr int HEAD = 64, KEYS = 64, WARPS = 8, QUERIES = 16 * WARPS;
constexpr int PITCH = HEAD + 8; // Values from a stored row to the next: eight rows lie in different banks.

__device__ inline u32 pack(float a, float b, __nv_bfloat16) {
    __nv_bfloat162 v = __floats2bfloat162_rn(a, b);
    return *reinterpret_cast<u32 *>(&v);
}
__device__ inline u32 pack(float a, float b, __half) {
    __half2 v = __floats2half2_rn(a, b);
    return *reinterpret_cast<u32 *>(&v);
}

// C += A B for A 16 x 16 and B 16 x 8.
__device__ inline void multiply(float *c, const u32 *a, u32 b0, u32 b1, __nv_bfloat16) {
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
                 : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
                 : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}
__device__ inline void multiply(float *c, const u32 *a, u32 b0, u32 b1, __half) {
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
                 : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
                 : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

// Four 8 x 8 blocks; thread i gives the address of row i % 8 of block i / 8.
__device__ inline void load(u32 *r, const void *row) {
    u32 address = (u32)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
                 : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
                 : "r"(address)
                 : "memory");
}
__device__ inline void load_transposed(u32 *r, const void *row) {
    u32 address = (u32)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
                 : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
                 : "r"(address)
                 : "memory");
}

// Copies 16 bytes without waiting for them; zeros if there is nothing to copy.
__device__ inline void copy(void *to, const void *from, bool there) {
    u32 address = (u32)__cvta_generic_to_shared(to);
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(address), "l"(from), "r"(there ? 16 : 0) : "memory");
}

// Rows first .. first + KEYS of a head into shared memory.
template <typename T> __device__ void fetch(T *to, const T *from, int first, int rows, i64 width) {
    for (int i = threadIdx.x; i < KEYS * HEAD / 8; i += 32 * WARPS) {
        int row = i / (HEAD / 8), column = i % (HEAD / 8) * 8;
        bool there = first + row < rows;
        copy(to + row * PITCH + column, from + (there ? first + row : 0) * width + column, there);
    }
}

// blockIdx: queries, head, sample. `scale` is that of the scores times log2(e).
template <typename T>
__device__ void flash(const T *q, const T *k, const T *v, T *y, int queries, int keys, int heads, float scale) {
    __shared__ __align__(16) T shared_keys[2][KEYS * PITCH];
    __shared__ __align__(16) T shared_values[2][KEYS * PITCH];
    const T type = T();
    i64 width = (i64)heads * HEAD;
    i64 head = blockIdx.y * HEAD;
    q += blockIdx.z * queries * width + head;
    y += blockIdx.z * queries * width + head;
    k += blockIdx.z * keys * width + head;
    v += blockIdx.z * keys * width + head;
    int lane = threadIdx.x % 32, group = lane / 4, pair = lane % 4 * 2;
    // This thread's two rows.
    int row[2];
    row[0] = blockIdx.x * QUERIES + threadIdx.x / 32 * 16 + group;
    row[1] = row[0] + 8;

    u32 query[HEAD / 16][4];
    for (int s = 0; s < HEAD / 16; s++)
        for (int i = 0; i < 4; i++) {
            int r = row[i % 2], column = 16 * s + pair + i / 2 * 8;
            query[s][i] = r < queries ? *reinterpret_cast<const u32 *>(q + r * width + column) : 0;
        }

    float out[HEAD / 8][4] = {}, largest[2] = {-INFINITY, -INFINITY}, sum[2] = {0.0f, 0.0f};
    int tiles = (keys + KEYS - 1) / KEYS;
    fetch(shared_keys[0], k, 0, keys, width);
    fetch(shared_values[0], v, 0, keys, width);
    asm volatile("cp.async.commit_group;" ::: "memory");
    for (int tile = 0; tile < tiles; tile++) {
        int now = tile % 2;
        if (tile + 1 < tiles) {
            fetch(shared_keys[1 - now], k, (tile + 1) * KEYS, keys, width);
            fetch(shared_values[1 - now], v, (tile + 1) * KEYS, keys, width);
        }
        asm volatile("cp.async.commit_group;" ::: "memory");
        asm volatile("cp.async.wait_group 1;" ::: "memory");
        __syncthreads();

        float score[KEYS / 8][4] = {};
        for (int n = 0; n < KEYS / 8; n++)
            for (int half = 0; half < HEAD / 32; half++) {
                u32 b[4];
                load(b, shared_keys[now] + (n * 8 + lane % 8) * PITCH + half * 32 + lane / 8 * 8);
                multiply(score[n], query[2 * half], b[0], b[1], type);
                multiply(score[n], query[2 * half + 1], b[2], b[3], type);
            }
        if ((tile + 1) * KEYS > keys)
            for (int n = 0; n < KEYS / 8; n++)
                for (int i = 0; i < 4; i++)
                    if (tile * KEYS + n * 8 + pair + i % 2 >= keys) score[n][i] = -INFINITY;

        for (int r = 0; r < 2; r++) {
            float top = largest[r];
            for (int n = 0; n < KEYS / 8; n++) top = fmaxf(top, fmaxf(score[n][2 * r], score[n][2 * r + 1]));
            top = fmaxf(top, __shfl_xor_sync(0xffffffffu, top, 1));
            top = fmaxf(top, __shfl_xor_sync(0xffffffffu, top, 2));
            float shrink = exp2f((largest[r] - top) * scale);
            largest[r] = top;
            sum[r] *= shrink;
            for (int n = 0; n < HEAD / 8; n++) {
                out[n][2 * r] *= shrink;
                out[n][2 * r + 1] *= shrink;
            }
            for (int n = 0; n < KEYS / 8; n++)
                for (int i = 2 * r; i < 2 * r + 2; i++) {
                    score[n][i] = exp2f((score[n][i] - top) * scale);
                    sum[r] += score[n][i];
                }
        }

        for (int s = 0; s < KEYS / 16; s++) {
            u32 weight[4];
            for (int i = 0; i < 4; i++) {
                const float *c = score[2 * s + i / 2] + 2 * (i % 2);
                weight[i] = pack(c[0], c[1], type);
            }
            for (int n = 0; n < HEAD / 8; n += 2) {
                u32 b[4];
                load_transposed(b, shared_values[now] + (s * 16 + lane % 16) * PITCH + (n + lane / 16) * 8);
                multiply(out[n], weight, b[0], b[1], type);
                multiply(out[n + 1], weight, b[2], b[3], type);
            }
        }
        __syncthreads(); // Before the next tile but one overwrites this one.
    }

    for (int r = 0; r < 2; r++) {
        sum[r] += __shfl_xor_sync(0xffffffffu, sum[r], 1);
        sum[r] += __shfl_xor_sync(0xffffffffu, sum[r], 2);
        if (row[r] >= queries) continue;
        for (int n = 0; n < HEAD / 8; n++)
            *reinterpret_cast<u32 *>(y + row[r] * width + n * 8 + pair) =
                pack(out[n][2 * r] / sum[r], out[n][2 * r + 1] / sum[r], type);
    }
}

#define ENTRY(T, S)                                                                                                   \
    extern "C" __global__ void __launch_bounds__(32 * WARPS)                                                          \
        flash_##S(const T *q, const T *k, const T *v, T *y, int queries, int keys, int heads, float scale) {          \
        flash(q, k, v, y, queries, keys, heads, scale);                                                               \
    }

ENTRY(__half, f16)
ENTRY(__nv_bfloat16, bf16)
